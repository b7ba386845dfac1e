"""Model the noise of a rate or thrust: a wandering disturbance, plus white noise or the difference of white noise.

The residual of a channel is r_k = b_k + e_k - mu e_(k-1), where the disturbance b is a random walk. A gyroscope has
mu = 0; the difference of two noisy attitudes has mu = 1. The Kalman filter of (b, e) turns residuals into innovations,
which are independent. The filter is linear, so it is applied to both commands and measurements before they are
compared. See Harvey, Forecasting, Structural Time Series Models and the Kalman Filter (1989), sections 3.2 and 4.2.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

DIFFUSE = 1e4  # variance of the first disturbance, in units of the white noise: a diffuse prior
DIRECT = ((0.0, 0.0), (0.0, 1e-3), (0.0, 3e-2), (0.0, 0.5))
"""Kinds of noise of a measured value: mu, and the increase of the disturbance's variance per tick, in units of e."""
DIFFERENCE = ((1.0, 0.0), (1.0, 1e-3), (0.8, 0.0), (0.8, 3e-2))
"""Kinds of noise of a difference of measured values; white process noise makes mu smaller than 1."""
KINDS = len(DIRECT)


class Whitening(eqx.Module):
    """Memory of the Kalman filters for all kinds of noise; all columns share the covariance."""

    disturbance: Float[Array, "kinds axes columns"]
    error: Float[Array, "kinds axes columns"]
    """Estimate of e_(k-1)."""
    spread: Float[Array, "kinds 3"]
    """Variance of the disturbance, its covariance with -e_(k-1), and the variance of e_(k-1)."""

    @classmethod
    def start(cls, axes: int, columns: int) -> "Whitening":
        """Return the memory before the first measurement."""
        zero = jnp.zeros((KINDS, axes, columns))
        return cls(zero, zero, jnp.tile(jnp.array([DIFFUSE, 0.0, 1.0]), (KINDS, 1)))

    def innovation(
        self, row: Float[Array, "axes columns"], kinds: Float[Array, "kinds 2"]
    ) -> tuple[Float[Array, "kinds axes columns"], Float[Array, " kinds"]]:
        """Return the innovation of each column, and its variance in units of the white noise.

        Args:
            row: Commands, other features and the measurement of each axis.
            kinds: :data:`DIRECT` or :data:`DIFFERENCE`.
        """
        mu = kinds[:, 0]
        b, cross, error = self.spread.T
        expected = self.disturbance - mu[:, None, None] * self.error
        return row[None] - expected, b + 2.0 * mu * cross + mu**2 * error + 1.0

    def after(
        self,
        innovation: Float[Array, "kinds axes columns"],
        kinds: Float[Array, "kinds 2"],
        counts: Bool[Array, ""],
        jumps: Bool[Array, ""],
    ) -> "Whitening":
        """Return the memory after a row with this innovation.

        Args:
            innovation: Result of :meth:`innovation`.
            kinds: :data:`DIRECT` or :data:`DIFFERENCE`.
            counts: Whether the row counts; otherwise only the time advances.
            jumps: Whether the disturbance has jumped, and is therefore unknown.
        """
        mu, wander = kinds.T
        b, cross, error = self.spread.T
        cross, error = mu * cross, mu**2 * error
        total = b + 2.0 * cross + error + 1.0
        gain = (b + cross) / total
        # Variance of b times that of the other terms, less the squared covariance, to avoid a difference of large
        # numbers.
        left = (b * (error + 1.0) - cross**2) / total
        gains = jnp.stack([left + wander, gain, 1.0 - 1.0 / total], axis=1)
        carry = jnp.stack([b + wander, jnp.zeros_like(b), jnp.ones_like(b)], axis=1)
        unknown = jnp.stack([jnp.full_like(b, DIFFUSE), jnp.zeros_like(b), jnp.ones_like(b)], axis=1)
        return Whitening(
            self.disturbance + jnp.where(counts, gain, 0.0)[:, None, None] * innovation,
            jnp.where(counts, 1.0 / total, 0.0)[:, None, None] * innovation,
            jnp.where(jumps, unknown, jnp.where(counts, gains, carry)),
        )
