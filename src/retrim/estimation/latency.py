"""Extrapolate old measurements to the current time, and test whether measurements are successive."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..physics import so3
from ..physics.dynamics import f_a
from ..physics.state import Command, State


def follows(t: Float[Array, ""], last: Float[Array, ""], dt: float) -> Bool[Array, ""]:
    """Return whether a measurement was taken one tick after the previous one.

    Args:
        t: Time of the measurement [s].
        last: Time of the previous measurement [s]; minus infinity for the first measurement.
        dt: Control tick [s].
    """
    return jnp.abs(t - last - dt) < 0.5 * dt


def ahead(x: State, u: Command, d: Float[Array, "3"], age: Float[Array, ""]) -> State:
    """Return the state ``age`` seconds after ``x`` from Eq. (1) of the paper, for constant acceleration and body rates.

    Args:
        x: Measured state.
        u: Command that has acted since the measurement.
        d: Disturbance, world [m/s^2].
        age: Age of the measurement [s].
    """
    a = f_a(x, u, d).v
    return State(x.p + age * x.v + 0.5 * age**2 * a, so3.mul(x.R, so3.exp(age * u.omega)), x.v + age * a)
