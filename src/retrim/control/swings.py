"""Measure self-induced oscillation: how far and how often an estimated disturbance swings back and forth."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

SWING = 2.0  # [m/s^2], smallest distance between two turning points of an axis
UNIT = 4.0  # [m/s^2], size of a swing that counts as one; others count by the square of their size
MEMORY = 1.5  # [s], time constant with which swings are forgotten


class Swings(eqx.Module):
    """Turning points of an estimate on each axis, and the size of the recent swings.

    A disturbance step, a load or a gust moves an estimate once. An observer that drives its own vehicle, because
    measurements are late or wrongly scaled, moves it back and forth by several m/s^2 more than once a second.
    """

    start: Float[Array, "3"]
    """Turning point at which the present swing began [m/s^2]."""
    extreme: Float[Array, "3"]
    """Farthest value since then [m/s^2]."""
    size: Float[Array, ""]
    """Sum of the squares of the swings of all axes in units of 4 m/s^2, with exponential forgetting."""

    @classmethod
    def none(cls, d: Float[Array, "3"]) -> "Swings":
        """Return the memory before the first swing, at the estimate ``d`` [m/s^2]."""
        return cls(d, d, jnp.zeros_like(d[0]))

    def after(self, d: Float[Array, "3"], dt: float) -> "Swings":
        """Return the memory one tick later.

        Args:
            d: New estimate, world [m/s^2].
            dt: Control tick [s].
        """
        direction = jnp.sign(self.extreme - self.start)
        back = (self.extreme - d) * direction
        reverses = (back > SWING) | (direction == 0.0)
        start = jnp.where(reverses, self.extreme, self.start)
        extreme = jnp.where(reverses | (back < 0.0), d, self.extreme)
        # A swing is counted while it grows, so that a large one counts at once.
        energy_gain = _squares(extreme - start) - jnp.where(reverses, 0.0, _squares(self.extreme - self.start))
        decay = jnp.exp(-dt / MEMORY).astype(d.dtype)
        return Swings(start, extreme, decay * self.size + jnp.sum(energy_gain))


def _squares(swing: Float[Array, "3"]) -> Float[Array, "3"]:
    return jnp.where(jnp.abs(swing) > SWING, (swing / UNIT) ** 2, 0.0)
