"""Build grids over the delay, the logarithm of the lag, and the ringing."""

import math

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .prior import LAGS, LONGEST_DELAY, MOST_RINGING, Belief, Prior

REACH = 2.4  # standard deviations that a grid covers on each side
TINY = 1e-14


def coarse_grid(prior: Prior, belief: Belief | None) -> tuple[Float[Array, "cells 3"], Float[Array, "3 3"]]:
    """Return a grid over the prior, and the covariance of a point within a cell."""
    n_delay, n_lag, n_ringing = 9, 10, 3 if prior.cells[2] > 1 else 1
    log_lag = jnp.linspace(math.log(LAGS[0]), math.log(LAGS[1]), n_lag)
    ringing = jnp.asarray((np.arange(n_ringing) + 0.5) * MOST_RINGING / n_ringing if n_ringing > 1 else np.zeros(1))
    if belief is None:
        d = jnp.linspace(0.0, LONGEST_DELAY, n_delay)
    else:
        d = belief.mean[0] + jnp.sqrt(belief.covariance[0, 0]) * jnp.linspace(-2.0, 2.0, 5)
    d = jnp.clip(d, 0.0, LONGEST_DELAY)
    cells = jnp.stack([x.reshape(-1) for x in jnp.meshgrid(d, log_lag, ringing, indexing="ij")], axis=1)
    spacing = jnp.stack(
        [d[1] - d[0], log_lag[1] - log_lag[0], jnp.array(MOST_RINGING / n_ringing if n_ringing > 1 else 0.0)]
    )
    return cells, jnp.diag((0.5 * spacing) ** 2)


def unit_grid(cells: tuple[int, int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Return the points of a grid in standard deviations, (n, 3), and their spacing along each axis."""
    axes = [np.linspace(-REACH, REACH, n) if n > 1 else np.zeros(1) for n in cells]
    points = np.stack([x.reshape(-1) for x in np.meshgrid(*axes, indexing="ij")], axis=1)
    return points, np.array([x[1] - x[0] if len(x) > 1 else 0.0 for x in axes])


def moments(
    cells: Float[Array, "cells 3"], weight: Float[Array, " cells"]
) -> tuple[Float[Array, "3"], Float[Array, "3 3"]]:
    """Return the mean and covariance of weighted cells."""
    mean = weight @ cells
    away = cells - mean[None]
    return mean, (weight[:, None] * away).T @ away


def cholesky(a: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """Return the lower Cholesky factor of a covariance.

    The factorisation is written out, since a LAPACK call takes longer and has no NumPy form.
    """
    zero = jnp.zeros_like(a[0, 0])
    l00 = jnp.sqrt(a[0, 0] + TINY)
    l10, l20 = a[1, 0] / l00, a[2, 0] / l00
    l11 = jnp.sqrt(jnp.maximum(a[1, 1] - l10**2, 0.0) + TINY)
    l21 = (a[2, 1] - l20 * l10) / l11
    l22 = jnp.sqrt(jnp.maximum(a[2, 2] - l20**2 - l21**2, 0.0) + TINY)
    return jnp.stack([jnp.stack([l00, zero, zero]), jnp.stack([l10, l11, zero]), jnp.stack([l20, l21, l22])])
