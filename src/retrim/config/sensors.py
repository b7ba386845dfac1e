"""Registry of sensor models."""

from collections.abc import Callable

from ..plants.sensors import SensorModel
from .registry import Registry

SENSORS: Registry[Callable[[], SensorModel | None]] = Registry(
    "sensor", example="module:name", expected="a function that returns a SensorModel"
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
register_sensor = SENSORS.register
