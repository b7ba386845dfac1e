"""Define the state x = (p, R, v) and the command u = (c, omega) of a quadrotor.

Throughout the library, the world frame has z up, the body frame is forward-left-up, and ``R`` maps body to world.
"""

import math
from collections.abc import Iterable
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

    def __repr__(self) -> str:
        """Return the rounded numbers of one drone's state; the shapes of a batch and of traced arrays."""
        if not _has_numbers(self.p, (3,)) or not _has_numbers(self.R, (3, 3)) or not _has_numbers(self.v, (3,)):
            return super().__repr__()
        R = self.R.tolist()
        angles = math.atan2(R[2][1], R[2][2]), math.asin(min(1.0, max(-1.0, -R[2][0]))), math.atan2(R[1][0], R[0][0])
        roll_pitch_yaw = _round_text(map(math.degrees, angles), 1)
        p, v = (_round_text(vector.tolist(), 3) for vector in (self.p, self.v))
        return f"State(p={p} m, v={v} m/s, roll_pitch_yaw={roll_pitch_yaw} deg)"


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

    def __repr__(self) -> str:
        """Return the rounded numbers of one command; the shapes of a batch and of traced arrays."""
        if not _has_numbers(self.c, ()) or not _has_numbers(self.omega, (3,)):
            return super().__repr__()
        return f"Command(c={self.c.tolist():z.3f} m/s^2, omega={_round_text(self.omega.tolist(), 3)} rad/s)"

    def within(self, low: "Command", high: "Command") -> "Command":
        """Return the command clipped to limits, entry by entry, in the command's own precision."""
        return Command(
            jnp.clip(self.c, low.c.astype(self.c.dtype), high.c.astype(self.c.dtype)),
            jnp.clip(self.omega, low.omega.astype(self.omega.dtype), high.omega.astype(self.omega.dtype)),
        )


def where(condition: Array, yes: T, no: T) -> T:
    """Apply ``jnp.where`` leaf by leaf, for a scalar condition."""
    result: T = jax.tree.map(lambda a, b: jnp.where(condition, a, b), yes, no)
    return result


def _has_numbers(leaf: Any, shape: tuple[int, ...]) -> bool:
    """Return whether a leaf is an array of this shape whose values are known, which those of a tracer are not."""
    return hasattr(leaf, "tolist") and not isinstance(leaf, jax.core.Tracer) and leaf.shape == shape


def _round_text(values: Iterable[float], digits: int) -> str:
    return "[" + ", ".join(f"{value:z.{digits}f}" for value in values) + "]"
