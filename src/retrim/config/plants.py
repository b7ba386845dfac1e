"""Registry of plants."""

from collections.abc import Callable
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np

from ..errors import ConfigError
from ..physics.actuator_response import ActuatorResponse
from ..physics.bem import BemQuadrotor
from ..physics.disturbance import Disturbance
from ..physics.rotors import LinearDragQuadrotor
from ..physics.second_order import DRAG, SecondOrderQuadrotor
from ..physics.step_response import step_responses
from ..physics.vehicle import Vehicle
from ..plants.bridges.betaflight import BetaflightPlant
from ..plants.bridges.betaflight_firmware import find_firmware
from ..plants.bridges.crazyflie import CrazyfliePlant
from ..plants.bridges.crazyflie import check_address as check_crazyflie
from ..plants.bridges.endpoint import address_of
from ..plants.bridges.mavlink import ADDRESS, MavlinkPlant
from ..plants.bridges.ros import RosPlant, parts_of
from ..plants.crazyflow import CrazyflowPlant
from ..plants.extras import check_extra
from ..plants.measurement_faults import AbstractMeasurementFault
from ..plants.mujoco import MujocoPlant
from ..plants.plant import Plant, as_numpy
from ..plants.rotorpy import RotorpyPlant
from ..plants.sensors import SensorModel
from ..plants.sim import SimPlant
from ..rospy_node import system_module
from .registry import Registry

DELAY = 0.02  # [s]: default command delay of plants with a configurable delay


@dataclass(frozen=True)
class PlantRequest:
    """The parameters of a plant, taken from a scenario."""

    vehicle: Vehicle
    disturbance: Disturbance
    sensors: SensorModel | None
    thrust_error: float
    """Relative thrust error; 0.1 means 10 % more thrust than commanded."""
    dt: float
    """Control period [s]."""
    seed: int
    delay: float = DELAY
    """Command delay [s]."""
    address: str = ""
    """Address of the vehicle; if empty, the default address of the link."""
    fault: AbstractMeasurementFault | None = None
    """Measurement fault; None for a plant without faults."""


@dataclass(frozen=True)
class PlantEntry:
    """A kind of plant."""

    make: Callable[[PlantRequest], Plant]
    about: str
    """Short description of the simulated system."""
    own_vehicle: str | None = None
    """Name of the plant's built-in vehicle; None if the plant can simulate any vehicle."""
    has_sensors: bool = False
    """Whether the plant supports sensor models."""
    has_faults: bool = False
    """Whether the plant supports measurement faults."""
    has_thrust_error: bool = False
    """Whether the plant supports an error of the thrust map."""
    has_delay: bool = False
    """Whether the plant supports a configurable command delay."""
    is_vehicle: bool = False
    """Whether the plant is a link to a vehicle, which runs in real time and whose world cannot be disturbed. An address
    may follow the plant's name, e.g. ``mavlink:udp:127.0.0.1:14540``. Such a plant is a
    :class:`~retrim.plants.bridges.vehicle_plant.VehiclePlant`."""
    has_world: bool = False
    """Whether retrim simulates the world around the vehicle, so disturbances can be applied."""
    check_address: Callable[[str], object] | None = None
    """Function that raises ConfigError if the address after a vehicle's name is invalid; None for no check."""
    needs: Callable[[], object] | None = None
    """Function that raises an error if a required program or package is missing, called before training; None if the
    plant has no requirements."""


PLANTS: Registry[PlantEntry] = Registry("plant", example="module:name of a PlantEntry")
register_plant = PLANTS.register


def _bem(r: PlantRequest) -> Plant:
    model = BemQuadrotor.of(r.vehicle, r.dt, thrust_error=r.thrust_error)
    return SimPlant(model, r.disturbance, delay_s=r.delay, sensors=r.sensors, fault=r.fault, seed=r.seed)


def _simple(r: PlantRequest) -> Plant:
    model = LinearDragQuadrotor.of(r.vehicle, r.dt, thrust_error=r.thrust_error)
    return SimPlant(model, r.disturbance, delay_s=r.delay, sensors=r.sensors, fault=r.fault, seed=r.seed)


def _second_order(r: PlantRequest) -> Plant:
    vehicle = r.vehicle
    lag = vehicle.rate_lag
    response = ActuatorResponse.of(
        vehicle.motor_tau,
        jnp.array([axis.rise for axis in step_responses(vehicle)]) if lag is None else lag,
        inverse_damping=0.0 if vehicle.rate_damping is None else 1.0 / vehicle.rate_damping,
        thrust_gain=1.0 + r.thrust_error,
    )
    limits = (vehicle.command_min, vehicle.command_max)
    model = SecondOrderQuadrotor(response, vehicle.mass, jnp.array(DRAG), limits, r.dt)
    return SimPlant(model, r.disturbance, delay_s=r.delay, sensors=r.sensors, fault=r.fault, seed=r.seed)


def find_plant(name: str) -> tuple[object, str]:
    """Return the object registered under a plant's name, and the address that follows the name.

    Raises:
        ConfigError: There is no such plant.
    """
    kind, _, address = name.partition(":")
    entry = PLANTS.get(kind)
    return (entry, address) if entry is not None and entry.is_vehicle else (PLANTS.find(name), "")


def is_vehicle(plant: str) -> bool:
    """Return whether a plant is a link to a vehicle.

    Raises:
        ConfigError: There is no such plant.
    """
    entry = find_plant(plant)[0]
    return isinstance(entry, PlantEntry) and entry.is_vehicle


def _limits(vehicle: Vehicle) -> tuple[np.ndarray, np.ndarray]:
    """Return the smallest and the largest command [c, omega]."""
    low, high = (as_numpy(u).astype(float) for u in (vehicle.command_min, vehicle.command_max))
    return low, high


def _mavlink(r: PlantRequest) -> Plant:
    return MavlinkPlant(r.address, r.dt, *_limits(r.vehicle))


def _crazyflie(r: PlantRequest) -> Plant:
    return CrazyfliePlant(r.address, r.dt, *_limits(r.vehicle))


def _ros(r: PlantRequest) -> Plant:
    return RosPlant(r.address, r.dt, *_limits(r.vehicle), float(r.vehicle.thrust_max / r.vehicle.mass))


def _betaflight(r: PlantRequest) -> Plant:
    model = BemQuadrotor.of(r.vehicle, r.dt, thrust_error=r.thrust_error)
    return BetaflightPlant(model, r.disturbance, *_limits(r.vehicle))


def _no_address(address: str) -> None:
    if address:
        raise ConfigError(f"plant 'betaflight' has no address, and {address!r} is one too many")


register_plant(
    "bem",
    PlantEntry(
        _bem,
        "blade-element rotors, firmware's rate loop, body drag, at 1 kHz, 20 ms of command delay",
        has_sensors=True,
        has_faults=True,
        has_thrust_error=True,
        has_delay=True,
    ),
)
register_plant(
    "simple",
    PlantEntry(
        _simple,
        "rotors with linear drag, at 1 kHz, 20 ms of command delay",
        has_sensors=True,
        has_faults=True,
        has_thrust_error=True,
        has_delay=True,
    ),
)
register_plant(
    "second-order",
    PlantEntry(
        _second_order,
        "a point mass behind a rate loop of second order and a thrust lag, at 1 kHz, 20 ms of command delay",
        has_sensors=True,
        has_faults=True,
        has_thrust_error=True,
        has_delay=True,
    ),
)
register_plant(
    "rotorpy",
    PlantEntry(
        lambda r: RotorpyPlant(r.disturbance, dt=r.dt),
        "rotorpy's aerodynamics, motors and rate loop, one tick of command delay",
        own_vehicle="hummingbird",
        needs=lambda: check_extra("rotorpy", "rotorpy"),
    ),
)
register_plant(
    "mujoco",
    PlantEntry(
        lambda r: MujocoPlant(r.vehicle, r.disturbance, dt=r.dt),
        "a body in MuJoCo's medium, one tick of command delay",
        needs=lambda: check_extra("mujoco", "mujoco"),
    ),
)
register_plant(
    "crazyflow",
    PlantEntry(
        lambda r: CrazyflowPlant(r.disturbance, dt=r.dt),
        "crazyflow's identified Crazyflie, one tick of command delay",
        own_vehicle="cf21B_500",
        needs=lambda: check_extra("crazyflow", "crazyflow"),
    ),
)
register_plant(
    "mavlink",
    PlantEntry(
        _mavlink,
        "a vehicle, or a simulation, that PX4 flies",
        is_vehicle=True,
        check_address=lambda address: address_of(address or ADDRESS),
        needs=lambda: check_extra("pymavlink", "mavlink", package="pymavlink"),
    ),
)
register_plant(
    "crazyflie",
    PlantEntry(
        _crazyflie,
        "a Crazyflie, or a simulated one, by CRTP over UDP",
        is_vehicle=True,
        check_address=check_crazyflie,
    ),
)
register_plant(
    "ros",
    PlantEntry(
        _ros,
        "a vehicle behind ROS 1: odometry or poses in, attitude targets out, as mavros has them",
        is_vehicle=True,
        check_address=parts_of,
        needs=lambda: system_module("rospy"),
    ),
)
register_plant(
    "betaflight",
    PlantEntry(
        _betaflight,
        "Betaflight's firmware as the rate controller of blade-element rotors, in real time",
        has_thrust_error=True,
        is_vehicle=True,
        has_world=True,
        check_address=_no_address,
        needs=find_firmware,
    ),
)
