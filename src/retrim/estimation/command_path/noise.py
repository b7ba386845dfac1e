"""Model the noise of a rate or thrust: a wandering disturbance, plus white noise or the difference of white noise.

The residual of a channel is r_k = b_k + e_k - mu e_(k-1). The disturbance b moves by a step s in each tick, and
s_(k+1) = phi s_k + w_k: b is a random walk if phi is 0, and smooth if phi is near 1. A gyroscope has mu = 0; the
difference of two noisy attitudes has mu = 1. The Kalman filter of (b, s, e) turns residuals into innovations, which are
independent. The filter is linear, so it is applied to both commands and measurements before they are compared.

A controller reacts to the disturbance, so a wrong model of the disturbance biases the gain: the innovations would
contain a predictable part, with which the commands are correlated (Ljung, System Identification, 1999, section 13.4).
For the filter and for trends with damped slopes, see Harvey, Forecasting, Structural Time Series Models and the Kalman
Filter (1989), chapter 2 and sections 3.2 and 4.2.
"""

from functools import cache

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

DIFFUSE = 1e4  # variance of the first disturbance, in units of the white noise: a diffuse prior
SMOOTH = 0.9  # phi of a smooth disturbance
DIRECT = (
    (0.0, 0.0, 0.0),
    (0.0, 1e-3, 0.0),
    (0.0, 3e-2, 0.0),
    (0.0, 0.5, 0.0),
    (0.0, 1e-2, SMOOTH),
    (0.0, 0.3, SMOOTH),
)
"""Kinds of noise of a measured value: mu, the variance of w in units of e, and phi."""
DIFFERENCE = (
    (1.0, 0.0, 0.0),
    (1.0, 1e-3, 0.0),
    (0.8, 0.0, 0.0),
    (0.8, 3e-2, 0.0),
    (0.8, 1e-2, SMOOTH),
    (0.0, 0.3, SMOOTH),
)
"""Kinds of noise of a difference of measured values; white process noise makes mu smaller than 1."""
KINDS = len(DIRECT)
SETTLED = 300  # steps after which the covariance of a filter no longer changes


class Whitening(eqx.Module):
    """Memory of the Kalman filters for all kinds of noise; all columns share the covariance."""

    mean: Float[Array, "kinds axes columns 3"]
    """Estimates of the disturbance b, its step s, and e_(k-1) of each column."""
    covariance: Float[Array, "kinds 3 3"]
    """Covariance of b, s and e_(k-1), in units of the white noise."""

    @classmethod
    def start(cls, axes: int, columns: int) -> "Whitening":
        """Return the memory before the first measurement."""
        return cls(
            jnp.zeros((KINDS, axes, columns, 3)), jnp.tile(jnp.diag(jnp.array([DIFFUSE, 0.0, 1.0])), (KINDS, 1, 1))
        )

    def innovation(
        self, row: Float[Array, "axes columns"], kinds: Float[Array, "kinds 3"], extra: Float[Array, ""] | float = 0.0
    ) -> tuple[Float[Array, "kinds axes columns"], Float[Array, " kinds"]]:
        """Return the innovation of each column, and its variance in units of the white noise.

        Args:
            row: Commands, other features and the measurement of each axis.
            kinds: :data:`DIRECT` or :data:`DIFFERENCE`.
            extra: Variance of the model error in this row, in units of the white noise.
        """
        reading = _reading(kinds)
        expected = jnp.einsum("kacs,ks->kac", self.mean, reading)
        return row[None] - expected, 1.0 + extra + jnp.einsum("ks,kst,kt->k", reading, self.covariance, reading)

    def after(
        self,
        innovation: Float[Array, "kinds axes columns"],
        kinds: Float[Array, "kinds 3"],
        counts: Bool[Array, ""],
        jumps: Bool[Array, ""],
        extra: Float[Array, ""] | float = 0.0,
    ) -> "Whitening":
        """Return the memory after a row with this innovation.

        Args:
            innovation: Result of :meth:`innovation`.
            kinds: :data:`DIRECT` or :data:`DIFFERENCE`.
            counts: Whether the row counts; otherwise only the time advances.
            jumps: Whether the disturbance has jumped, and is therefore unknown.
            extra: Variance of the model error in this row, in units of the white noise.
        """
        reading = _reading(kinds)
        across = jnp.einsum("kst,kt->ks", self.covariance, reading)
        total = 1.0 + extra + jnp.einsum("ks,ks->k", reading, across)
        gain = across / total[:, None]
        # Joseph's form avoids the difference of large numbers. The last entry becomes e_k, whose gain is 1 / total and
        # whose covariance with the others is minus their gain.
        keep = jnp.eye(3)[None] - gain[:, :, None] * reading[:, None, :]
        left = keep @ self.covariance @ keep.mT + (1.0 + extra) * gain[:, :, None] * gain[:, None, :]
        left = _with_last(left, -gain[:, :2], 1.0 - 1.0 / total)
        gain = jnp.concatenate([gain[:, :2], 1.0 / total[:, None]], axis=1)
        carry = _with_last(self.covariance, jnp.zeros_like(gain[:, :2]), jnp.ones_like(total))
        unknown = _with_last(
            jnp.zeros_like(carry).at[:, 0, 0].set(DIFFUSE), jnp.zeros_like(gain[:, :2]), jnp.ones_like(total)
        )
        mean = self.mean.at[..., 2].set(0.0) + gain[:, None, None, :] * jnp.where(counts, innovation, 0.0)[..., None]
        mean = jnp.where(jumps, mean.at[..., 1].set(0.0), mean)
        covariance = jnp.where(jumps, unknown, jnp.where(counts, left, carry))
        motion = jnp.tile(jnp.eye(3), (kinds.shape[0], 1, 1)).at[:, 0, 1].set(1.0).at[:, 1, 1].set(kinds[:, 2])
        covariance = (motion @ covariance @ motion.mT).at[:, 1, 1].add(kinds[:, 1])
        return Whitening(jnp.einsum("kst,kact->kacs", motion, mean), covariance)


@cache
def predictable_share(kinds: tuple[tuple[float, float, float], ...]) -> np.ndarray:
    """Return the share of the variance of an innovation that the disturbance causes, for each kind of noise.

    Args:
        kinds: :data:`DIRECT` or :data:`DIFFERENCE`.
    """
    return np.array([_share(*kind) for kind in kinds])


def _share(mu: float, q: float, phi: float) -> float:
    if q == 0.0:
        return 0.0
    motion, process_noise = np.array([[1.0, 1.0, 0.0], [0.0, phi, 0.0], [0.0, 0.0, 0.0]]), np.diag([0.0, q, 0.0])
    reading, own = np.array([1.0, 0.0, -mu]), np.array([0.0, 0.0, 1.0])
    covariance = np.diag([1.0, q, 1.0])
    for _ in range(SETTLED):
        across, total = covariance @ reading, reading @ covariance @ reading + 1.0
        # The new e is correlated with the innovation.
        gain = (motion @ across + own) / total
        covariance = motion @ covariance @ motion.T + process_noise + np.outer(own, own) - total * np.outer(gain, gain)
    return float(covariance[0, 0] / (reading @ covariance @ reading + 1.0))


def _reading(kinds: Float[Array, "kinds 3"]) -> Float[Array, "kinds 3"]:
    """Return the factors of b, s and e_(k-1) in a residual."""
    one = jnp.ones_like(kinds[:, 0])
    return jnp.stack([one, 0.0 * one, -kinds[:, 0]], axis=1)


def _with_last(
    covariance: Float[Array, "kinds 3 3"], across: Float[Array, "kinds 2"], last: Float[Array, " kinds"]
) -> Float[Array, "kinds 3 3"]:
    """Return the covariance with the last row and column replaced."""
    return covariance.at[:, 2, :2].set(across).at[:, :2, 2].set(across).at[:, 2, 2].set(last)
