"""Define the state x = (p, R, v) and the command u = (c, omega) of a quadrotor.

Throughout the library, the world frame has z up, the body frame is forward-left-up, and ``R`` maps body to world.
"""

from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

T = TypeVar("T")

STANDARD_GRAVITY = 9.81  # [m/s^2], the paper's u_hover = [9.81, 0, 0, 0]


class StateDot(eqx.Module):
    """Rate of change of a :class:`State`; the body rates describe the rotation."""

    p: Float[Array, "3"]
    """Velocity, world [m/s]."""
    omega: Float[Array, "3"]
    """Body rates [rad/s]."""
    v: Float[Array, "3"]
    """Acceleration, world [m/s^2]."""


class State(eqx.Module):
    """State x = (p, R, v): 15 numbers (paper, Sec. III-B)."""

    p: Float[Array, "3"]
    """Position, world [m]."""
    R: Float[Array, "3 3"]
    """Attitude, body to world."""
    v: Float[Array, "3"]
    """Velocity, world [m/s]."""

    @classmethod
    def at(cls, p: Float[Array, "3"]) -> "State":
        """Return the state of a level vehicle at rest at the position ``p`` [m]."""
        return cls(p, jnp.eye(3, dtype=p.dtype), jnp.zeros_like(p))

    def vector(self) -> Float[Array, "15"]:
        """Return [p, vec R (row by row), v]."""
        return jnp.concatenate([self.p, self.R.reshape(9), self.v])


class Command(eqx.Module):
    """Command u = (c, omega): collective thrust and body rates (CTBR), 4 numbers."""

    c: Float[Array, ""]
    """Mass-normalised collective thrust along body z [m/s^2]; 9.81 for hover."""
    omega: Float[Array, "3"]
    """Body rates [rad/s]."""

    @classmethod
    def hover(cls, dtype: Any = None) -> "Command":
        """Return u_hover = [9.81, 0, 0, 0].

        Args:
            dtype: Type of the arrays; None for JAX's default, with a weakly typed thrust. A command that is carried
                from tick to tick needs the same type as its successors. Otherwise, the first tick is compiled
                separately.
        """
        return cls(jnp.array(STANDARD_GRAVITY, dtype=dtype), jnp.zeros(3, dtype=dtype))

    def vector(self) -> Float[Array, "4"]:
        """Return [c, omega]."""
        return jnp.concatenate([self.c[None], self.omega])

    @classmethod
    def of(cls, vector: Float[Array, "4"]) -> "Command":
        """Return the command from a vector, the inverse of :meth:`vector`."""
        return cls(vector[0], vector[1:])

    def within(self, low: "Command", high: "Command") -> "Command":
        """Return the command clipped to limits, entry by entry, in the command's own precision."""
        return Command(
            jnp.clip(self.c, low.c.astype(self.c.dtype), high.c.astype(self.c.dtype)),
            jnp.clip(self.omega, low.omega.astype(self.omega.dtype), high.omega.astype(self.omega.dtype)),
        )


def where(condition: Array, yes: T, no: T) -> T:
    """Apply ``jnp.where`` leaf by leaf, for a scalar condition."""
    chosen: T = jax.tree.map(lambda a, b: jnp.where(condition, a, b), yes, no)
    return chosen
