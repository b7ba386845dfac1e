"""What an old measurement says of now."""

from jaxtyping import Array, Float

from ..physics import so3
from ..physics.dynamics import f_a
from ..physics.state import Command, State


def ahead(x: State, u: Command, d: Float[Array, "3"], age: Float[Array, ""]) -> State:
    """Return the state a while after ``x``, by Eq. (1) of the paper with constant acceleration and body rates.

    Args:
        x: State that was measured.
        u: Command that has acted since.
        d: Disturbance, world [m/s^2].
        age: How old the measurement is [s].
    """
    a = f_a(x, u, d).v
    return State(x.p + age * x.v + 0.5 * age**2 * a, so3.mul(x.R, so3.exp(age * u.omega)), x.v + age * a)
