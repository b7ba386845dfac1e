"""Extrapolation of old measurements to the current time, and a test for successive measurements."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..physics import so3
from ..physics.dynamics import f_a
from ..physics.state import Command, State


def follows(t: Float[Array, ""], last: Float[Array, ""], dt: float) -> Bool[Array, ""]:
    """Return whether a measurement follows the previous one by one tick, so that their difference is that of one tick.

    Args:
        t: Time of the measurement [s].
        last: Time of the previous measurement [s]; minus infinity for the first measurement.
        dt: Control tick [s].
    """
    return jnp.abs(t - last - dt) < 0.5 * dt


def ahead(x: State, u: Command, d: Float[Array, "3"], age: Float[Array, ""]) -> State:
    """Return the state ``age`` after ``x``, by Eq. (1) of the paper with constant acceleration and body rates.

    Args:
        x: Measured state.
        u: Command that has acted since then.
        d: Disturbance, world [m/s^2].
        age: Age of the measurement [s].
    """
    a = f_a(x, u, d).v
    return State(x.p + age * x.v + 0.5 * age**2 * a, so3.mul(x.R, so3.exp(age * u.omega)), x.v + age * a)
