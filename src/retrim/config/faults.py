"""Registry of measurement faults, with optional sizes: ``velocity-spikes=3``."""

from collections.abc import Callable
from functools import partial

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..errors import ConfigError
from ..plants.measurement_faults import (
    AbstractMeasurementFault,
    DriftingPosition,
    Frozen,
    Gaps,
    JumpingClock,
    Late,
    Repeated,
    ScaledVelocity,
    WrongState,
)
from .registry import Registry
from .sizes import name_and_size

NO_FAULT = "none"
TICKS = "ticks"

FaultFactory = Callable[[float | None], AbstractMeasurementFault | None]
"""Function that takes a size (or None for the default size) and returns a fault."""

FAULTS: Registry[FaultFactory] = Registry(
    "fault", example="module:name of a function of a size", expected="a function of a size"
)
register_fault = FAULTS.register


def measurement_fault(name: str) -> AbstractMeasurementFault | None:
    """Return a measurement fault by name.

    Args:
        name: Name, e.g. ``late``, or name with a size, e.g. ``late=3``; the result for ``none`` is None.

    Raises:
        ConfigError: The fault does not exist, or does not accept this size.
    """
    kind, size = name_and_size(name, "fault")
    try:
        fault = FAULTS.find(kind)(size)
    except (TypeError, ValueError) as error:
        raise error if isinstance(error, ConfigError) else ConfigError(f"fault {name!r}: {error}") from error
    if fault is not None and not isinstance(fault, AbstractMeasurementFault):
        raise ConfigError(f"fault {name!r} returns {type(fault).__name__}, expected an AbstractMeasurementFault")
    return fault


def _register(
    name: str, make: Callable[[float], AbstractMeasurementFault], default: float, low: float, high: float, unit: str
) -> None:
    def make_checked(size: float | None) -> AbstractMeasurementFault:
        value = default if size is None else size
        if not low <= value <= high:
            raise ConfigError(f"fault {name!r}: the size must be between {low:g} and {high:g} {unit}, got {value:g}")
        if unit == TICKS and not value.is_integer():
            raise ConfigError(f"fault {name!r}: the size must be a whole number of {TICKS}, got {value:g}")
        return make(value)

    FAULTS.register(name, make_checked)


def _none(size: float | None) -> None:
    if size is not None:
        raise ConfigError(f"fault {NO_FAULT!r} has no size, got {size:g}")


def _along_x(size: float) -> Float[Array, "3"]:
    return jnp.array([size, 0.0, 0.0])


def _velocity_error(size: float, every: int) -> WrongState:
    return WrongState(jnp.zeros(3), jnp.zeros(3), _along_x(size), jnp.array(every))


def _swap_markers(angle: float) -> WrongState:
    return WrongState(jnp.array([0.05, -0.03, 0.02]), jnp.array([0.0, 0.0, angle]), jnp.zeros(3), jnp.array(50))


def _tilt(angle: float) -> WrongState:
    return WrongState(jnp.zeros(3), _along_x(angle), jnp.zeros(3), jnp.array(1))


FAULTS.register(NO_FAULT, _none)
_register("velocity-spikes", partial(_velocity_error, every=25), 2.0, -20.0, 20.0, "m/s")
_register("rare-spikes", partial(_velocity_error, every=150), 3.0, -20.0, 20.0, "m/s")
_register("swapped-markers", _swap_markers, 1.5, -3.2, 3.2, "rad")
_register("late", lambda size: Late(round(size)), 3.0, 1.0, 25.0, TICKS)
_register("frozen", lambda size: Frozen(jnp.array(200), round(size)), 15.0, 1.0, 100.0, TICKS)
_register("repeated", lambda size: Repeated(jnp.array(size)), 0.2, 0.0, 0.95, "of all measurements")
_register("scaled-velocity", lambda size: ScaledVelocity(jnp.array(size)), 0.5, 0.0, 3.0, "times the velocity")
_register("velocity-bias", partial(_velocity_error, every=1), 0.1, -5.0, 5.0, "m/s")
_register("attitude-bias", _tilt, 0.03, -0.5, 0.5, "rad")
_register("drift", lambda size: DriftingPosition(_along_x(size), jnp.array(250.0)), 0.1, 0.0, 5.0, "m")
_register("gaps", lambda size: Gaps(150, round(size)), 5.0, 1.0, 50.0, TICKS)
_register("clock-jumps", lambda size: JumpingClock(100, size), 0.1, -2.0, 2.0, "s")
