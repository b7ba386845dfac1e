"""Define the prior of a channel before a flight, and pass information from one channel to another."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .channel import Coefficients, PathPosterior

LONGEST_DELAY = 0.12  # [s]
LAGS = (0.005, 0.5)  # [s]
MOST_RINGING = 0.86  # a damping ratio of 0.29
TINY = 1e-14


class Prior(eqx.Module):
    """Prior of a channel before any flight."""

    gain: Float[Array, ""]
    """Mean of the gain [-]."""
    gain_spread: Float[Array, ""]
    """Standard deviation of the gain."""
    lag: Float[Array, ""]
    """Median of the lag [s]."""
    lag_spread: Float[Array, ""]
    """Standard deviation of the logarithm of the lag."""
    other: Float[Array, " n"]
    """Standard deviations of the coefficients of other features."""
    noise: Float[Array, ""]
    """Typical standard deviation of the noise."""
    floor: Float[Array, ""]
    """Smallest standard deviation of unmodelled effects."""
    hover: Float[Array, ""]
    """Hover command; commands and measurements are differences from it."""
    cells: tuple[int, int, int] = eqx.field(static=True)
    """Number of cells along delay, lag and damping; one cell along damping means a first-order channel."""


class Belief(NamedTuple):
    """Normal distribution of the delay, the logarithm of the lag, and the gain, from another channel."""

    mean: Float[Array, "2"]
    """Delay [s], logarithm of the lag [s]."""
    covariance: Float[Array, "2 2"]
    gain: Float[Array, ""]
    """Mean of the gain at ``mean``."""
    slope: Float[Array, "2"]
    """Derivative of the mean of the gain with respect to the delay and the logarithm of the lag."""
    gain_spread: Float[Array, ""]
    """Standard deviation of the gain, given the other two."""


class GainPrior(NamedTuple):
    """Prior of the gain in each cell."""

    mean: Float[Array, " cells"]
    spread: Float[Array, ""]


def coefficients_before(prior: Prior, push: Coefficients | None = None) -> Coefficients:
    """Return the distribution of the coefficients of other features.

    Args:
        prior: Prior of the channel.
        push: Distribution of the first coefficients from other measurements, if there is one.
    """
    mean, information = jnp.zeros_like(prior.other), jnp.diag(prior.other**-2)
    if push is None:
        return Coefficients(mean, information)
    n = push.mean.shape[0]
    return Coefficients(mean.at[:n].set(push.mean), information.at[:n, :n].set(push.information))


def delay_belief(posterior: PathPosterior, prior: Prior) -> Belief:
    """Return the belief about the delay, which all channels share, from a channel of a different quantity."""
    delay = posterior.cells[:, 0]
    mean = posterior.weight @ delay
    variance = posterior.weight @ (delay - mean) ** 2
    covariance = jnp.diag(jnp.stack([variance, prior.lag_spread**2]))
    middle = jnp.stack([mean, jnp.log(prior.lag)])
    return Belief(middle, covariance, prior.gain, jnp.zeros_like(middle), prior.gain_spread)


def full_belief(posterior: PathPosterior) -> Belief:
    """Return the belief from another sensor of the same quantity, with the correlation of delay, lag and gain."""
    cells, weight = posterior.cells[:, :2], posterior.weight
    mean, gain = weight @ cells, weight @ posterior.gain
    away, off = cells - mean[None], posterior.gain - gain
    covariance = (weight[:, None] * away).T @ away
    slope = _inverse(covariance) @ ((weight * off) @ away)
    variance = weight @ ((off - away @ slope) ** 2 + posterior.gain_variance)
    return Belief(mean, covariance, gain, slope, jnp.sqrt(variance))


def gain_prior(cells: Float[Array, "cells 3"], prior: Prior, belief: Belief | None) -> GainPrior:
    """Return the prior of the gain in each cell."""
    if belief is None:
        return GainPrior(jnp.broadcast_to(prior.gain, cells.shape[:1]), prior.gain_spread)
    return GainPrior(belief.gain + (cells[:, :2] - belief.mean[None]) @ belief.slope, belief.gain_spread)


def log_prior(cells: Float[Array, "cells 3"], prior: Prior, belief: Belief | None) -> Float[Array, " cells"]:
    """Return the logarithm of the prior of delay, lag and ringing; minus infinity outside their ranges."""
    d, log_lag, ringing = cells.T
    inside = (d >= 0.0) & (d <= LONGEST_DELAY) & (log_lag >= jnp.log(LAGS[0])) & (log_lag <= jnp.log(LAGS[1]))
    inside &= (ringing >= 0.0) & (ringing <= MOST_RINGING)
    if belief is None:
        result = -0.5 * ((log_lag - jnp.log(prior.lag)) / prior.lag_spread) ** 2
    else:
        away = cells[:, :2] - belief.mean[None]
        result = -0.5 * jnp.sum(away * (away @ _inverse(belief.covariance)), axis=1)
    return jnp.where(inside, result, -jnp.inf)


def _inverse(a: Float[Array, "2 2"]) -> Float[Array, "2 2"]:
    """Return the inverse of a covariance, with a correlation of at most 0.9999."""
    a = a + jnp.diag(1e-4 * jnp.diag(a) + TINY)
    adjugate = jnp.stack([jnp.stack([a[1, 1], -a[0, 1]]), jnp.stack([-a[1, 0], a[0, 0]])])
    return adjugate / (a[0, 0] * a[1, 1] - a[0, 1] * a[1, 0])
