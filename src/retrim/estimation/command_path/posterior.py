"""Posterior of one channel over delay, lag and damping, on grids that close in on where it lies.

Given these three, gain and noise have a conjugate posterior (normal, inverse gamma), so that they are integrated in
closed form. The grid covers the ellipsoid in which the posterior of the last tick lies. It moves and shrinks with it. A
coarse grid over the prior finds where else the posterior may be, for example after a change of the vehicle; it tempers
the likelihood, since its cells are wider than the ridge. All shapes are fixed and nothing is compiled anew.
"""

import math
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .channel import Channel, PathPosterior, Region
from .history import ages
from .response import mean_step_response

LONGEST_DELAY = 0.12  # [s]
LAGS = (0.005, 0.5)  # [s]
MOST_RINGING = 0.86  # a damping ratio of 0.29
TEMPER = 0.03  # share of the information that a coarse grid uses
ELSEWHERE = 2.0  # by so much must the log posterior be larger outside of the grid to leave it
WIDER = 1.2  # the next grid covers this times the covariance, since a posterior may also widen
REACH = 2.4  # standard deviations that a grid covers on each side
COARSE = 0.35  # share of the spacing of a grid that is the least deviation of the next one
TINY = 1e-14
GAINS = (0.2, 5.0)  # within which a gain is linearised
FREEDOM = 2.0  # twice the shape of the inverse gamma prior of the variance of the noise


class Prior(eqx.Module):
    """What is known of a channel before any flight."""

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
    """Standard deviation of the noise that is typical."""
    floor: Float[Array, ""]
    """Least standard deviation of what no model explains."""
    hover: Float[Array, ""]
    """Command that hovers, from which commands and measurements are differences."""
    cells: tuple[int, int, int] = eqx.field(static=True)
    """Cells of each grid along delay, lag and damping; one along damping means that the channel is of first order."""


class Belief(NamedTuple):
    """Normal distribution of delay, logarithm of the lag, and gain, which another channel has found."""

    mean: Float[Array, "2"]
    """Delay [s], logarithm of the lag [s]."""
    covariance: Float[Array, "2 2"]
    gain: Float[Array, ""]
    """Mean of the gain at ``mean``."""
    slope: Float[Array, "2"]
    """Change of the mean of the gain with delay and logarithm of the lag."""
    gain_spread: Float[Array, ""]
    """Standard deviation of the gain where the other two are known."""


class _Sums(NamedTuple):
    """Sums without the other features, added over the axes."""

    uu: Float[Array, "*kinds m m"]
    uz: Float[Array, "*kinds m"]
    zz: Float[Array, "*kinds"]
    half_log: Float[Array, "*kinds"]
    total: Float[Array, ""]
    """Sum of the weights of the measurements."""


class _GainPrior(NamedTuple):
    mean: Float[Array, " cells"]
    spread: Float[Array, ""]


class _Fit(NamedTuple):
    """What the sums say of each cell."""

    log_likelihood: Float[Array, " cells"]
    gain: Float[Array, " cells"]
    gain_variance: Float[Array, " cells"]
    variance: Float[Array, " cells"]


def path_posterior(channel: Channel, prior: Prior, belief: Belief | None, dt: float) -> PathPosterior:
    """Return the posterior of a channel.

    Args:
        channel: Its sums.
        prior: What is known before any flight.
        belief: What other channels say; None if this one is the first.
        dt: Control tick [s].
    """
    sums = _without_others(channel, prior)
    grid, step = (jnp.asarray(x, channel.response.dtype) for x in _unit_grid(prior.cells))

    def likelihood_of(cells: Float[Array, "cells 3"], one: _Sums) -> tuple[_Fit, Float[Array, "cells m"]]:
        h = responses(cells, channel.age, channel.width, prior.hover, dt)
        return _fit(one, h, channel, prior, _gain_prior(cells, prior, belief)), h

    def around(region: Region) -> tuple[Float[Array, "cells 3"], Float[Array, "3 3"]]:
        factor = _cholesky(region.covariance)
        least = (factor * (COARSE * step[None]) ** 2) @ factor.T
        return region.mean[None] + grid @ factor.T, least

    def region_of(cells: Float[Array, "cells 3"], fit: _Fit, temper: float, least: Float[Array, "3 3"]) -> Region:
        weight = _weight(fit.log_likelihood, cells, prior, belief, temper)
        mean, covariance = _moments(cells, weight)
        return Region(mean, WIDER * covariance + least)

    cells, least = around(channel.region)
    h = responses(cells, channel.age, channel.width, prior.hover, dt)
    fits = _fits(sums, h, channel, prior, _gain_prior(cells, prior, belief))
    kind = jnp.argmax(jax.nn.logsumexp(fits.log_likelihood + _log_prior(cells, prior, belief)[None], axis=1))
    one = _Sums(sums.uu[kind], sums.uz[kind], sums.zz[kind], sums.half_log[kind], sums.total)
    fit: _Fit = jax.tree.map(lambda leaf: leaf[kind], fits)
    region = region_of(cells, fit, 1.0, least)
    coarse, within = _coarse(prior, belief)
    far, _ = likelihood_of(coarse, one)
    best, found = (
        jnp.max(each.log_likelihood + _log_prior(at, prior, belief)) for each, at in ((far, coarse), (fit, cells))
    )
    restart = region_of(coarse, far, TEMPER, within)
    region = jax.tree.map(lambda new, old: jnp.where(best > found + ELSEWHERE, new, old), restart, region)
    cells, least = around(region)
    fit, h = likelihood_of(cells, one)
    weight = _weight(fit.log_likelihood, cells, prior, belief, 1.0)
    scaled = fit.gain[:, None] * h
    response = weight @ scaled
    off, middle = scaled - response[None], weight @ h
    spread = (weight[:, None] * off).T @ off + (weight @ fit.gain_variance) * jnp.outer(middle, middle)
    noise = jnp.sqrt(weight @ fit.variance)
    region = region_of(cells, fit, 1.0, least)
    return PathPosterior(cells, weight, fit.gain, fit.gain_variance, response, spread, noise, kind, region)


def log_likelihood(
    channel: Channel, prior: Prior, cells: Float[Array, "cells 3"], dt: float
) -> Float[Array, "kinds cells"]:
    """Return the log likelihood of some cells for each kind of noise, up to a constant; for the arguments see above."""
    sums, h = _without_others(channel, prior), responses(cells, channel.age, channel.width, prior.hover, dt)
    return _fits(sums, h, channel, prior, _gain_prior(cells, prior, None)).log_likelihood


def channel_before(axes: int, prior: Prior, dt: float) -> Channel:
    """Return a channel before the first measurement; its ``axes`` share all parameters but their disturbances."""
    cells, within = _coarse(prior, None)
    zero = jnp.zeros(())
    h, weight = responses(cells, zero, zero, prior.hover, dt), jax.nn.softmax(_log_prior(cells, prior, None))
    response = prior.gain * weight @ h
    off = prior.gain * h - response[None]
    spread = (weight[:, None] * off).T @ off + prior.gain_spread**2 * jnp.outer(response, response)
    mean, covariance = _moments(cells, weight)
    return Channel.start(axes, prior.other.shape[0], response, spread, prior.noise, Region(mean, covariance + within))


def delay_belief(posterior: PathPosterior, prior: Prior) -> Belief:
    """Return what a channel of another quantity says: the delay, which all channels share."""
    delay = posterior.cells[:, 0]
    mean = posterior.weight @ delay
    variance = posterior.weight @ (delay - mean) ** 2
    covariance = jnp.diag(jnp.stack([variance, prior.lag_spread**2]))
    middle = jnp.stack([mean, jnp.log(prior.lag)])
    return Belief(middle, covariance, prior.gain, jnp.zeros_like(middle), prior.gain_spread)


def full_belief(posterior: PathPosterior) -> Belief:
    """Return what another sensor of the same quantity says, with the correlation of delay, lag and gain."""
    cells, weight = posterior.cells[:, :2], posterior.weight
    mean, gain = weight @ cells, weight @ posterior.gain
    away, off = cells - mean[None], posterior.gain - gain
    covariance = (weight[:, None] * away).T @ away
    slope = _inverse(covariance) @ ((weight * off) @ away)
    variance = weight @ ((off - away @ slope) ** 2 + posterior.gain_variance)
    return Belief(mean, covariance, gain, slope, jnp.sqrt(variance))


def responses(
    cells: Float[Array, "cells 3"],
    age: Float[Array, ""],
    width: Float[Array, ""],
    hover: Float[Array, ""],
    dt: float,
) -> Float[Array, "cells m"]:
    """Return what each cell makes of the features of the commands.

    Args:
        cells: Delay [s], logarithm of the lag [s], ringing.
        age: Time since the end of the measured mean [s].
        width: Length of the mean [s].
        hover: Command from which the features are differences.
        dt: Control tick [s].
    """
    delay, lag, ringing = cells[:, :1], jnp.exp(cells[:, 1:2]), jnp.clip(cells[:, 2:], 0.0, MOST_RINGING)
    t = dt * jnp.asarray(ages(dt), dtype=cells.dtype)[None] - delay - age
    settled = jnp.ones_like(delay)
    return jnp.concatenate([mean_step_response(t, width, lag, ringing), settled, hover * settled], axis=1)


def _without_others(channel: Channel, prior: Prior) -> _Sums:
    """Integrate over the coefficients of the other features, one after another, and add the axes."""
    m = channel.response.shape[0]
    # The sum of squared weights corrects the information for forgetting: old measurements are known in part.
    temper = channel.count / jnp.maximum(channel.squares, 1.0)
    products = temper * channel.products
    for i in range(prior.other.shape[0]):
        row = products[..., m + i, :]
        pivot = row[..., m + i] + (channel.noise / prior.other[i]) ** 2
        products -= row[..., :, None] * row[..., None, :] / pivot[..., None, None]
    products = jnp.sum(products, axis=1)
    return _Sums(
        products[:, :m, :m],
        products[:, :m, -1],
        products[:, -1, -1],
        temper * channel.half_log,
        temper * channel.count,
    )


def _fits(sums: _Sums, h: Float[Array, "cells m"], channel: Channel, prior: Prior, gain: _GainPrior) -> _Fit:
    """Return :func:`_fit` for each kind of noise."""
    parts = (sums.uu, sums.uz, sums.zz, sums.half_log)
    return jax.vmap(lambda uu, uz, zz, half: _fit(_Sums(uu, uz, zz, half, sums.total), h, channel, prior, gain))(*parts)


def _gain_prior(cells: Float[Array, "cells 3"], prior: Prior, belief: Belief | None) -> _GainPrior:
    if belief is None:
        return _GainPrior(jnp.broadcast_to(prior.gain, cells.shape[:1]), prior.gain_spread)
    return _GainPrior(belief.gain + (cells[:, :2] - belief.mean[None]) @ belief.slope, belief.gain_spread)


def _fit(sums: _Sums, h: Float[Array, "cells m"], channel: Channel, prior: Prior, gain: _GainPrior) -> _Fit:
    """Integrate over gain and noise; everything is a difference from the present prediction of the channel."""
    g = jnp.clip(channel.response[-2], *GAINS)
    away = g * h - channel.response[None]
    across = away @ sums.uu
    alone = sums.zz - 2.0 * away @ sums.uz + jnp.sum(away * across, axis=1)
    slope = jnp.sum(h * (sums.uz[None] - across), axis=1)
    square = jnp.sum(h * (across + (sums.uu @ channel.response)[None]), axis=1) / g
    # The prior of the gain counts like one measurement of it.
    before, off = (channel.noise / gain.spread) ** 2, gain.mean - g
    square, slope, alone = jnp.maximum(square, 0.0) + before, slope + before * off, alone + before * off**2
    left = jnp.maximum(alone - slope**2 / square, 0.0) + sums.total * prior.floor**2 + FREEDOM * prior.noise**2
    freedom = sums.total + FREEDOM
    variance = left / freedom
    likelihood = -0.5 * jnp.log(square / before) - 0.5 * freedom * jnp.log(left) - sums.half_log
    return _Fit(likelihood, g + slope / square, variance / square, variance)


def _log_prior(cells: Float[Array, "cells 3"], prior: Prior, belief: Belief | None) -> Float[Array, " cells"]:
    d, log_lag, ringing = cells.T
    inside = (d >= 0.0) & (d <= LONGEST_DELAY) & (log_lag >= jnp.log(LAGS[0])) & (log_lag <= jnp.log(LAGS[1]))
    inside &= (ringing >= 0.0) & (ringing <= MOST_RINGING)
    if belief is None:
        found = -0.5 * ((log_lag - jnp.log(prior.lag)) / prior.lag_spread) ** 2
    else:
        away = cells[:, :2] - belief.mean[None]
        found = -0.5 * jnp.sum(away * (away @ _inverse(belief.covariance)), axis=1)
    return jnp.where(inside, found, -jnp.inf)


def _weight(
    likelihood: Float[Array, " cells"],
    cells: Float[Array, "cells 3"],
    prior: Prior,
    belief: Belief | None,
    temper: float,
) -> Float[Array, " cells"]:
    return jax.nn.softmax(temper * likelihood + _log_prior(cells, prior, belief))


def _coarse(prior: Prior, belief: Belief | None) -> tuple[Float[Array, "cells 3"], Float[Array, "3 3"]]:
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


def _unit_grid(cells: tuple[int, int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Return the points of a grid in standard deviations, (n, 3), and their spacing along each axis."""
    axes = [np.linspace(-REACH, REACH, n) if n > 1 else np.zeros(1) for n in cells]
    points = np.stack([x.reshape(-1) for x in np.meshgrid(*axes, indexing="ij")], axis=1)
    return points, np.array([x[1] - x[0] if len(x) > 1 else 0.0 for x in axes])


def _moments(
    cells: Float[Array, "cells 3"], weight: Float[Array, " cells"]
) -> tuple[Float[Array, "3"], Float[Array, "3 3"]]:
    mean = weight @ cells
    away = cells - mean[None]
    return mean, (weight[:, None] * away).T @ away


def _inverse(a: Float[Array, "2 2"]) -> Float[Array, "2 2"]:
    """Return the inverse of a covariance, with a correlation of 0.9999 at most."""
    a = a + jnp.diag(1e-4 * jnp.diag(a) + TINY)
    turned = jnp.stack([jnp.stack([a[1, 1], -a[0, 1]]), jnp.stack([-a[1, 0], a[0, 0]])])
    return turned / (a[0, 0] * a[1, 1] - a[0, 1] * a[1, 0])


def _cholesky(a: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """Return the lower factor of a covariance, written out: a call of LAPACK takes longer, and has no NumPy form."""
    zero = jnp.zeros_like(a[0, 0])
    l00 = jnp.sqrt(a[0, 0] + TINY)
    l10, l20 = a[1, 0] / l00, a[2, 0] / l00
    l11 = jnp.sqrt(jnp.maximum(a[1, 1] - l10**2, 0.0) + TINY)
    l21 = (a[2, 1] - l20 * l10) / l11
    l22 = jnp.sqrt(jnp.maximum(a[2, 2] - l20**2 - l21**2, 0.0) + TINY)
    return jnp.stack([jnp.stack([l00, zero, zero]), jnp.stack([l10, l11, zero]), jnp.stack([l20, l21, l22])])
