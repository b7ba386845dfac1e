"""Registry of disturbances, with optional sizes: ``wind=6+payload=0.1``."""

from collections.abc import Callable

import jax.numpy as jnp
from jax import random
from jaxtyping import Array, Key

from ..errors import ConfigError
from ..physics.disturbance import Constant, Disturbance, Kick, RandomWalk, Reversing, Step, SumOfDisturbances
from ..physics.downwash import Downwash
from ..physics.faults import BatterySag, Payload, WeakRotor
from ..physics.proximity import LANDING_GEAR, Ceiling, TableEdge
from ..physics.slung_load import SlungLoad
from ..physics.wind import Dryden, Fan, SteadyWind
from .registry import Registry
from .sizes import name_and_size

DisturbanceFactory = Callable[[Key[Array, ""], float | None], Disturbance]
"""Function that takes a random key and a size (or None for the default size), and returns a disturbance."""

GOAL_HEIGHT = 1.0  # [m], height of the default goal and of the built-in references
SEED_TAG = 2**30 + 3  # folded into seeds, to keep disturbances from sharing keys with starts, learners or sensors

DISTURBANCES: Registry[DisturbanceFactory] = Registry(
    "disturbance", example="sums as wind+payload=0.1, or module:name", expected="a function of a random key and a size"
)
register_disturbance = DISTURBANCES.register


def disturbance(names: str, seed: int = 0) -> Disturbance:
    """Return a disturbance by name.

    Args:
        names: Name, e.g. ``wind``; name with a size, e.g. ``wind=6``; or a sum, e.g. ``wind=6+payload``.
        seed: Seed of the random parts of the disturbance.

    Raises:
        ConfigError: The disturbance does not exist, or does not accept this size.
    """
    parts = list[Disturbance]()
    for i, part in enumerate(names.split("+")):
        name, size = name_and_size(part, "disturbance")
        factory = DISTURBANCES.find(name)
        key = random.fold_in(random.fold_in(random.key(seed), SEED_TAG), i)
        try:
            result = factory(key, size)
        except (TypeError, ValueError) as error:
            raise ConfigError(f"disturbance {part!r}: {error}") from error
        if not callable(result):
            raise ConfigError(f"disturbance {part!r} returns {type(result).__name__}, expected a retrim.Disturbance")
        parts.append(result)
    return parts[0] if len(parts) == 1 else SumOfDisturbances(tuple(parts))


def _check_size(size: float | None, default: float, low: float, high: float, unit: str) -> float:
    value = default if size is None else size
    if not low <= value <= high:
        raise ConfigError(f"a size of {value:g} {unit} must be between {low:g} and {high:g}")
    return value


def _push(level: float | None) -> DisturbanceFactory:
    def make(key: Key[Array, ""], size: float | None) -> Disturbance:
        if level is not None and size is not None:
            raise ConfigError("this level is fixed; use push=SIZE [m/s^2 per axis]")
        return Constant(jnp.full(3, level if level is not None else _check_size(size, 1.0, -10.0, 10.0, "m/s^2")))

    return make


def _diagonal(speed: float) -> Array:
    wind: Array = jnp.array([speed / 2.0**0.5, speed / 2.0**0.5, 0.0])
    return wind


def _fan(key: Key[Array, ""], size: float | None) -> Disturbance:
    # The outlet is 1.5 m from the goal (0, 0, 1), diagonally; by default, the wind is 4 m/s at the goal.
    outlet, direction = jnp.array([-1.06, -1.06, 1.0]), jnp.array([1.0, 1.0, 0.0])
    return Fan.of(outlet, direction, speed=_check_size(size, 6.0, 0.0, 20.0, "m/s"), width=0.3, key=key)


def _table_edge(key: Key[Array, ""], size: float | None) -> Disturbance:
    # The table begins under the centre of the built-in circle, and its top is below the height of the built-in goal.
    clearance = _check_size(size, 0.02, 0.0, 0.5, "m")
    return TableEdge.of(GOAL_HEIGHT - LANDING_GEAR - clearance, 1.0)


def _ceiling(key: Key[Array, ""], size: float | None) -> Disturbance:
    return Ceiling.of(GOAL_HEIGHT + _check_size(size, 0.05, 0.0, 1.0, "m"))


def _downwash(key: Key[Array, ""], size: float | None) -> Disturbance:
    # The second vehicle is above the far end of the built-in circle.
    above = _check_size(size, 0.75, 0.3, 3.0, "m")
    return Downwash.of(jnp.array([2.0, 0.0, GOAL_HEIGHT + above]))


_BUILT_IN: dict[str, DisturbanceFactory] = {
    "none": _push(0.0),
    "small": _push(0.5),  # the paper's levels [m/s^2] per axis (Sec. IV-B)
    "large": _push(2.0),
    "push": _push(None),
    "push-x": lambda key, size: Constant(  # Sec. IV-C of the paper
        jnp.array([_check_size(size, 2.0, -10.0, 10.0, "m/s^2"), 0.0, 0.0])
    ),
    "step": lambda key, size: Step(jnp.full(3, _check_size(size, 2.0, -10.0, 10.0, "m/s^2")), jnp.array(8.0)),
    "early-step": lambda key, size: Step(jnp.full(3, _check_size(size, 2.0, -10.0, 10.0, "m/s^2")), jnp.array(4.0)),
    "kick": lambda key, size: Kick(  # size: speed gained within 0.1 s along a horizontal diagonal
        10.0 * _diagonal(_check_size(size, 3.0, 0.0, 10.0, "m/s")), jnp.array(8.0), jnp.array(0.1)
    ),
    "reversing": lambda key, size: Reversing(  # Sec. IV-B.3
        jnp.full(3, _check_size(size, 0.5, -10.0, 10.0, "m/s^2")), jnp.array(15.0)
    ),
    # The bounds, +-1 m/s^2, are those that the paper uses to train DATT.
    "walk": lambda key, size: RandomWalk.of(_check_size(size, 0.5, 0.0, 10.0, "m/s^2"), 1.0, key=key),
    "wind": lambda key, size: SteadyWind(_diagonal(_check_size(size, 4.0, 0.0, 20.0, "m/s"))),
    "gusts": lambda key, size: Dryden.of(_diagonal(_check_size(size, 4.0, 0.5, 20.0, "m/s")), key=key),
    "fan": _fan,
    "table-edge": _table_edge,  # size: clearance below the vehicle
    "ceiling": _ceiling,  # size: distance above the rotors
    "downwash": _downwash,  # size: height of a second vehicle above the goal
    "payload": lambda key, size: Payload.of(_check_size(size, 0.07, 0.0, 20.0, "kg")),  # the paper: 190 g become 260 g
    "off-centre": lambda key, size: Payload.of(0.07, ahead=_check_size(size, 0.03, -0.2, 0.2, "m")),  # the same load
    "pickup": lambda key, size: Payload.of(_check_size(size, 0.07, 0.0, 20.0, "kg"), picked=8.0, dropped=20.0),
    # Sizes: mass of the load as a share of the vehicle's, or the length of the cable of a load of 30 %.
    "slung-load": lambda key, size: SlungLoad.of(_check_size(size, 0.3, 0.02, 1.0, "of the mass")),
    "slung-cable": lambda key, size: SlungLoad.of(0.3, length=_check_size(size, 0.5, 0.2, 3.0, "m")),
    "slung-pickup": lambda key, size: SlungLoad.of(
        _check_size(size, 0.3, 0.02, 1.0, "of the mass"), picked=8.0, dropped=20.0
    ),
    "battery": lambda key, size: BatterySag(  # size: relative loss of thrust per second
        jnp.array(_check_size(size, 0.002, 0.0, 0.1, "1/s")), jnp.array(0.8)
    ),
    "weak-rotor": lambda key, size: WeakRotor.of(0, _check_size(size, 0.9, 0.3, 1.0, "of its thrust")),
}
for _name, _factory in _BUILT_IN.items():
    DISTURBANCES.register(_name, _factory)
