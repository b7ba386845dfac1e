"""What pushes the vehicle: functions (t, x) -> external acceleration, world frame [m/s^2].

Disturbances belong to the plant. The nominal model never hears of them.
"""

from typing import Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .state import State


@runtime_checkable
class Disturbance(Protocol):
    """Any function of time [s] and state will do."""

    def __call__(self, t: Float[Array, ""], x: State, /) -> Float[Array, "3"]:
        """External acceleration at time ``t`` in the state ``x``, world [m/s^2]."""
        ...


class Constant(eqx.Module):
    """The same acceleration at all times; the paper's none, small and large (Sec. IV-B)."""

    a: Float[Array, "3"]

    def __call__(self, t: Float[Array, ""], x: State) -> Float[Array, "3"]:
        """``a``."""
        return self.a


class Reversing(eqx.Module):
    """``+a`` and ``-a`` by turns, reversed every ``period`` seconds (paper, Sec. IV-B.3: every 15 s)."""

    a: Float[Array, "3"]
    period: Float[Array, ""]

    def __check_init__(self) -> None:
        """Raise ``ValueError`` if the period is not positive."""
        if not isinstance(self.period, jax.core.Tracer) and not self.period > 0:
            raise ValueError(f"Reversing.period = {float(self.period)} s must be positive")

    def __call__(self, t: Float[Array, ""], x: State) -> Float[Array, "3"]:
        """``a`` in the first period, ``-a`` in the second, and so on."""
        return jnp.where(jnp.floor(t / self.period) % 2.0 == 0.0, self.a, -self.a)
