"""Plants by name."""

from collections.abc import Callable
from dataclasses import dataclass

from ..physics.bem import BemQuadrotor
from ..physics.disturbance import Disturbance
from ..physics.rotors import LinearDragQuadrotor
from ..physics.vehicle import Vehicle
from ..plants.crazyflow import CrazyflowPlant
from ..plants.mujoco import MujocoPlant
from ..plants.plant import Plant
from ..plants.rotorpy import RotorpyPlant
from ..plants.sensors import SensorModel
from ..plants.sim import SimPlant
from .registry import Registry

DELAY = 0.02  # [s], of commands, where a scenario may choose it


@dataclass(frozen=True)
class PlantRequest:
    """What a scenario asks of a plant."""

    vehicle: Vehicle
    disturbance: Disturbance
    sensors: SensorModel | None
    thrust_error: float
    """By how much more than commanded the rotors give, as a share."""
    dt: float
    """Control period [s]."""
    seed: int
    delay: float = DELAY
    """Command delay [s]."""


@dataclass(frozen=True)
class PlantEntry:
    """A kind of plant."""

    make: Callable[[PlantRequest], Plant]
    about: str
    """What it simulates, in a few words."""
    own_vehicle: str | None = None
    """Name of the vehicle that it brings; None if it flies any."""
    has_sensors: bool = False
    """Whether it takes a sensor model."""
    has_thrust_error: bool = False
    """Whether it takes an error of the thrust map."""
    has_delay: bool = False
    """Whether it takes a command delay."""


PLANTS: Registry[PlantEntry] = Registry("plant", example="module:name of a PlantEntry")
register_plant = PLANTS.register


def _bem(r: PlantRequest) -> Plant:
    model = BemQuadrotor.of(r.vehicle, r.dt, thrust_error=r.thrust_error)
    return SimPlant(model, r.disturbance, delay_s=r.delay, sensors=r.sensors, seed=r.seed)


def _simple(r: PlantRequest) -> Plant:
    model = LinearDragQuadrotor.of(r.vehicle, r.dt, thrust_error=r.thrust_error)
    return SimPlant(model, r.disturbance, delay_s=r.delay, sensors=r.sensors, seed=r.seed)


register_plant(
    "bem",
    PlantEntry(
        _bem,
        "blade-element rotors, firmware's rate loop, body drag, at 1 kHz, 20 ms of command delay",
        has_sensors=True,
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
    ),
)
register_plant(
    "mujoco",
    PlantEntry(
        lambda r: MujocoPlant(r.vehicle, r.disturbance, dt=r.dt),
        "a body in MuJoCo's medium, one tick of command delay",
    ),
)
register_plant(
    "crazyflow",
    PlantEntry(
        lambda r: CrazyflowPlant(r.disturbance, dt=r.dt),
        "crazyflow's identified Crazyflie, one tick of command delay",
        own_vehicle="cf21B_500",
    ),
)
