"""Registry of sensor models."""

from collections.abc import Callable
from typing import Any

from ..errors import ConfigError
from ..plants.camera_sensors import CameraSensors
from ..plants.sensors import AbstractSensors, SensorModel
from .registry import Registry

SENSORS: Registry[Callable[[], AbstractSensors[Any] | None]] = Registry(
    "sensor", example="module:name", expected="a function that returns AbstractSensors"
)
SENSORS.register("ideal", lambda: None)
SENSORS.register(
    "mocap",
    lambda: SensorModel.of(position=0.3e-3, velocity=3e-3, attitude=1e-3, gyro=0.01, accelerometer=0.1),
)
SENSORS.register(
    "onboard",
    lambda: SensorModel.of(
        position=0.6e-3, velocity=6e-3, attitude=2e-3, dropout=0.01, latency=10, gyro=0.02, accelerometer=0.2
    ),
)
SENSORS.register(
    "rough",
    lambda: SensorModel.of(
        position=1e-3, velocity=10e-3, attitude=3e-3, dropout=0.05, latency=10, gyro=0.03, accelerometer=0.3
    ),
)
SENSORS.register("camera", CameraSensors.of)
register_sensor = SENSORS.register


def make_sensors(name: str) -> AbstractSensors[Any] | None:
    """Build sensors by name; None for exact measurements.

    Raises:
        ConfigError: There are no such sensors, or the function returns something else.
    """
    sensors: object = SENSORS.find(name)()
    if sensors is None or isinstance(sensors, AbstractSensors):
        return sensors
    raise ConfigError(f"sensors {name!r} is a {type(sensors).__name__}, expected a retrim.AbstractSensors")
