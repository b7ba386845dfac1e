"""What flights meet, by name: vehicles, disturbances, sensors, plants."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Literal, get_args

import jax.numpy as jnp
from jax import random
from jaxtyping import Array, Key

from .adapt.plant import Plant
from .adapt.plants import CrazyflowPlant, MujocoPlant, RotorpyPlant, SimPlant
from .adapt.sensing import Sensing
from .physics.bem import Bem
from .physics.disturbance import Constant, Disturbance, RandomWalk, Reversing, Together
from .physics.rotors import Rotors
from .physics.trouble import BatterySag, Payload, WeakRotor
from .physics.vehicle import Vehicle, kingfisher, large, small
from .physics.wind import Dryden, Fan, SteadyWind
from .presets import DT, PresetError

VehicleName = Literal["small", "large", "kingfisher"]
PlantName = Literal["bem", "simple", "rotorpy", "mujoco", "crazyflow"]
SensingName = Literal["ideal", "mocap", "rough"]

VEHICLES: dict[str, Callable[[], Vehicle]] = {"small": small, "large": large, "kingfisher": kingfisher}

OWN_VEHICLE = {"rotorpy": "hummingbird", "crazyflow": "cf21B_500"}
"""Plants that bring a vehicle with them, under the name that they give it."""

ABOUT = {
    "bem": "blade-element rotors, firmware's rate loop, body drag, at 1 kHz, 20 ms of command delay",
    "simple": "rotors with linear drag, at 1 kHz, 20 ms of command delay",
    "rotorpy": "rotorpy's aerodynamics, motors and rate loop, 20 ms of command delay",
    "mujoco": "a body in MuJoCo's medium, 20 ms of command delay",
    "crazyflow": "crazyflow's identified Crazyflie, 20 ms of command delay",
}

GUSTS = 3  # folded into a seed for disturbances, so that they share no key with starts and learners


def _push(level: float, key: Key[Array, ""]) -> Constant:
    return Constant(jnp.full(3, level))


def _fan(key: Key[Array, ""]) -> Fan:
    # at the goal (0, 0, 1): 4 m/s on the axis, diagonally, from 1.5 m away
    outlet, direction = jnp.array([-1.06, -1.06, 1.0]), jnp.array([1.0, 1.0, 0.0])
    return Fan.of(outlet, direction, speed=6.0, width=0.3, key=key)


WIND = (2.8284271, 2.8284271, 0.0)  # [m/s]: 4 m/s, diagonally

DISTURBANCES: dict[str, Callable[[Key[Array, ""]], Disturbance]] = {
    "none": partial(_push, 0.0),
    "small": partial(_push, 0.5),  # the paper's levels, m/s^2 per axis (Sec. IV-B)
    "large": partial(_push, 2.0),
    "reversing": lambda key: Reversing(jnp.full(3, 0.5), jnp.array(15.0)),  # Sec. IV-B.3
    "walk": lambda key: RandomWalk.of(0.5, 1.0, key=key),  # bounds: the paper's for training DATT, +-1 m/s^2
    "wind": lambda key: SteadyWind(jnp.array(WIND)),
    "gusts": lambda key: Dryden.of(jnp.array(WIND), key=key),
    "fan": _fan,
    "payload": lambda key: Payload.of(0.07),  # the paper's stand: 190 g become 260 g
    "pickup": lambda key: Payload.of(0.07, picked=8.0, dropped=20.0),
    "battery": lambda key: BatterySag(jnp.array(0.002), jnp.array(0.8)),  # -0.2 % of the thrust per second
    "weak-rotor": lambda key: WeakRotor.of(0, 0.9),
}

SENSING: dict[str, Callable[[], Sensing | None]] = {
    "ideal": lambda: None,
    "mocap": lambda: Sensing.of(position=0.3e-3, velocity=3e-3, attitude=1e-3),
    "rough": lambda: Sensing.of(position=1e-3, velocity=10e-3, attitude=3e-3, dropout=0.05, latency=10),
}


def disturbance(names: str, seed: int = 0) -> Disturbance:
    """By name; ``a+b`` is both at once. What is random about it is drawn from ``seed``."""
    parts = list[Disturbance]()
    for i, name in enumerate(names.split("+")):
        if name not in DISTURBANCES:
            raise PresetError(f"no disturbance {name!r}; there are {', '.join(DISTURBANCES)}, and sums as wind+payload")
        key = random.fold_in(random.fold_in(random.key(seed), GUSTS), i)
        parts.append(DISTURBANCES[name](key))
    return parts[0] if len(parts) == 1 else Together(tuple(parts))


@dataclass(frozen=True)
class Setting:
    """Where a flight takes place. ``vehicle`` None: the plant's own, where it has one; else the small quadrotor."""

    plant: PlantName = "bem"
    vehicle: VehicleName | None = None
    sensing: SensingName = "ideal"
    thrust_error: float = 0.035
    """By how much more than commanded the rotors give, as a share; bem and simple only."""

    def __post_init__(self) -> None:
        """Raise :class:`PresetError` for an unknown name, and for a choice that the plant does not have."""
        for field, names in (("plant", PlantName), ("vehicle", VehicleName), ("sensing", SensingName)):
            value = getattr(self, field)
            if value not in get_args(names) and not (field == "vehicle" and value is None):
                raise PresetError(f"no {field} {value!r}; there are {', '.join(get_args(names))}")
        if self.plant in OWN_VEHICLE and self.vehicle is not None:
            raise PresetError(
                f"plant {self.plant} flies its own vehicle, {OWN_VEHICLE[self.plant]}, not {self.vehicle}"
            )
        if self.plant not in ("bem", "simple") and self.sensing != "ideal":
            raise PresetError(f"plant {self.plant} shows its true state; sensing {self.sensing!r} needs bem or simple")
        if not -0.5 <= self.thrust_error <= 0.5:
            raise PresetError(f"thrust error {self.thrust_error} must be between -0.5 and 0.5")

    @property
    def flown(self) -> str:
        """Name of the vehicle that flies."""
        return OWN_VEHICLE.get(self.plant) or self.vehicle or "small"

    def make(self, disturbances: str, seed: int = 0) -> Plant:
        """The plant, in disturbances by name. Raises ``PlantError`` where an extra is not installed."""
        around = disturbance(disturbances, seed)
        car = VEHICLES[self.vehicle or "small"]()
        if self.plant == "bem":
            return SimPlant(
                Bem.of(car, DT, thrust_error=self.thrust_error), around, sensing=SENSING[self.sensing](), seed=seed
            )
        if self.plant == "simple":
            return SimPlant(
                Rotors.of(car, DT, thrust_error=self.thrust_error), around, sensing=SENSING[self.sensing](), seed=seed
            )
        if self.plant == "mujoco":
            return MujocoPlant(car, around, dt=DT)
        if self.plant == "rotorpy":
            return RotorpyPlant(around, dt=DT)
        return CrazyflowPlant(around, dt=DT)
