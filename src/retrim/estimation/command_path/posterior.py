"""Compute the posterior of one channel over delay, lag and damping, on grids that adapt to its region.

Given delay, lag and damping, the gain and the noise have a conjugate posterior (normal, inverse gamma), so both are
integrated in closed form. The grid covers the ellipsoid of the last tick's posterior, and moves and shrinks with the
posterior. A coarse grid over the prior finds other regions of the posterior, for example after a change to the vehicle.
The coarse grid tempers the likelihood, since its cells are wider than the ridge of the likelihood. All shapes are
fixed, so nothing is recompiled.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .channel import Channel, Coefficients, PathPosterior, Region, with_coefficients
from .grid import cholesky, coarse_grid, moments, unit_grid
from .history import ages
from .prior import MOST_RINGING, Belief, GainPrior, Prior, coefficients_before, gain_prior, log_prior
from .response import mean_step_response

TEMPER = 0.03  # share of the information that a coarse grid uses
MOVE_EXCESS = 2.0  # excess of the log posterior outside the grid at which the grid moves there
COVARIANCE_FACTOR = 1.2  # factor on the covariance for the next grid, since a posterior may also widen
LEAST_DEVIATION = 0.35  # smallest deviation of the next grid, as a share of the spacing of the present one
SHARE = 4  # one of so many cells is used to choose the kind of noise; no factor in common with the sides of the grids
GAINS = (0.2, 5.0)  # range in which a gain is linearised
FREEDOM = 2.0  # twice the shape of the inverse gamma prior of the noise variance


class _Sums(NamedTuple):
    """Sums without the other features, added over the axes."""

    uu: Float[Array, "*kinds m m"]
    uz: Float[Array, "*kinds m"]
    zz: Float[Array, "*kinds"]
    half_log: Float[Array, "*kinds"]
    total: Float[Array, ""]
    """Sum of the weights of the measurements."""


class _Fit(NamedTuple):
    """Fit of each cell to the sums."""

    log_likelihood: Float[Array, " cells"]
    gain: Float[Array, " cells"]
    gain_variance: Float[Array, " cells"]
    variance: Float[Array, " cells"]


def path_posterior(
    channel: Channel, prior: Prior, belief: Belief | None, dt: float, others: Coefficients | None = None
) -> PathPosterior:
    """Return the posterior of a channel.

    Args:
        channel: Sums of the channel.
        prior: Prior before any flight.
        belief: Information from other channels; None if this channel is the first.
        dt: Control tick [s].
        others: Distribution of the coefficients of the other features; by default, that before any flight.
    """
    sums = _without_others(channel, coefficients_before(prior) if others is None else others)
    grid, step = (jnp.asarray(x, channel.response.dtype) for x in unit_grid(prior.cells))

    def around(region: Region) -> tuple[Float[Array, "cells 3"], Float[Array, "3 3"]]:
        factor = cholesky(region.covariance)
        least = (factor * (LEAST_DEVIATION * step[None]) ** 2) @ factor.T
        return region.mean[None] + grid @ factor.T, least

    def region_of(
        cells: Float[Array, "cells 3"], likelihood: Float[Array, " cells"], temper: float, least: Float[Array, "3 3"]
    ) -> Region:
        weight = _weight(likelihood, cells, prior, belief, temper)
        mean, covariance = moments(cells, weight)
        return Region(mean, COVARIANCE_FACTOR * covariance + least)

    cells, least = around(channel.region)
    coarse, within = coarse_grid(prior, belief)
    n, both = cells.shape[0], jnp.concatenate([cells, coarse])
    h, gain = responses(both, channel.age, channel.width, prior.hover, dt), gain_prior(both, prior, belief)
    before = log_prior(both, prior, belief)
    some = slice((n // 2) % SHARE, n, SHARE)
    fits = _fits(sums, h[some], channel, prior, GainPrior(gain.mean[some], gain.spread))
    kind = jnp.argmax(jax.nn.logsumexp(fits.log_likelihood + before[some][None], axis=1))
    one = _Sums(sums.uu[kind], sums.uz[kind], sums.zz[kind], sums.half_log[kind], sums.total)
    likelihood = _fit(one, h, channel, prior, gain).log_likelihood
    region = region_of(cells, likelihood[:n], 1.0, least)
    restart = region_of(coarse, likelihood[n:], TEMPER, within)
    restarts = jnp.max((likelihood + before)[n:]) > jnp.max((likelihood + before)[:n]) + MOVE_EXCESS
    region = jax.tree.map(lambda new, old: jnp.where(restarts, new, old), restart, region)
    cells, least = around(region)
    h = responses(cells, channel.age, channel.width, prior.hover, dt)
    fit = _fit(one, h, channel, prior, gain_prior(cells, prior, belief))
    weight = _weight(fit.log_likelihood, cells, prior, belief, 1.0)
    cell_responses = fit.gain[:, None] * h
    response = weight @ cell_responses
    off, middle = cell_responses - response[None], weight @ h
    spread = (weight[:, None] * off).T @ off + (weight @ fit.gain_variance) * jnp.outer(middle, middle)
    noise = jnp.sqrt(weight @ fit.variance)
    region = region_of(cells, fit.log_likelihood, 1.0, least)
    return PathPosterior(cells, weight, fit.gain, fit.gain_variance, response, spread, noise, kind, region)


def log_likelihood(
    channel: Channel, prior: Prior, cells: Float[Array, "cells 3"], dt: float
) -> Float[Array, "kinds cells"]:
    """Return the log likelihood of cells for each kind of noise, up to a constant; see :func:`path_posterior`."""
    sums = _without_others(channel, coefficients_before(prior))
    h = responses(cells, channel.age, channel.width, prior.hover, dt)
    return _fits(sums, h, channel, prior, gain_prior(cells, prior, None)).log_likelihood


def channel_before(axes: int, prior: Prior, dt: float) -> Channel:
    """Return a channel before the first measurement; its ``axes`` share all parameters except for disturbances."""
    cells, within = coarse_grid(prior, None)
    zero = jnp.zeros(())
    h, weight = responses(cells, zero, zero, prior.hover, dt), jax.nn.softmax(log_prior(cells, prior, None))
    response = prior.gain * weight @ h
    off = prior.gain * h - response[None]
    spread = (weight[:, None] * off).T @ off + prior.gain_spread**2 * jnp.outer(response, response)
    mean, covariance = moments(cells, weight)
    return Channel.start(axes, prior.other, response, spread, prior.noise, Region(mean, covariance + within))


def responses(
    cells: Float[Array, "cells 3"],
    age: Float[Array, ""],
    width: Float[Array, ""],
    hover: Float[Array, ""],
    dt: float,
) -> Float[Array, "cells m"]:
    """Return the response of each cell to the features of the commands.

    Args:
        cells: Delay [s], logarithm of the lag [s], ringing.
        age: Time since the end of the averaging interval [s].
        width: Length of the averaging interval [s].
        hover: Hover command; the features are differences from it.
        dt: Control tick [s].
    """
    delay, lag, ringing = cells[:, :1], jnp.exp(cells[:, 1:2]), jnp.clip(cells[:, 2:], 0.0, MOST_RINGING)
    t = dt * jnp.asarray(ages(dt), dtype=cells.dtype)[None] - delay - age
    ones = jnp.ones_like(delay)
    return jnp.concatenate([mean_step_response(t, width, lag, ringing), ones, hover * ones], axis=1)


def _without_others(channel: Channel, others: Coefficients) -> _Sums:
    """Integrate over the coefficients of the other features, and add the axes."""
    m, n, temper = channel.response.shape[0], others.mean.shape[0], channel.temper
    products = with_coefficients(temper * channel.products, others, channel.noise)
    half_log = temper * channel.half_log
    if n > 0:
        rows = products[..., m : m + n, :]
        factors = jax.scipy.linalg.lu_factor(rows[..., m : m + n])
        products -= rows.mT @ jax.scipy.linalg.lu_solve(factors, rows)
        pivots = jnp.diagonal(factors[0], axis1=-2, axis2=-1)
        half_log += 0.5 * jnp.sum(jnp.log(jnp.abs(pivots)), axis=(1, 2))
    products = jnp.sum(products, axis=1)
    return _Sums(
        products[:, :m, :m],
        products[:, :m, -1],
        products[:, -1, -1],
        half_log,
        temper * channel.count,
    )


def _fits(sums: _Sums, h: Float[Array, "cells m"], channel: Channel, prior: Prior, gain: GainPrior) -> _Fit:
    """Return :func:`_fit` for each kind of noise."""
    parts = (sums.uu, sums.uz, sums.zz, sums.half_log)
    return jax.vmap(lambda uu, uz, zz, half: _fit(_Sums(uu, uz, zz, half, sums.total), h, channel, prior, gain))(*parts)


def _fit(sums: _Sums, h: Float[Array, "cells m"], channel: Channel, prior: Prior, gain: GainPrior) -> _Fit:
    """Integrate over gain and noise; all quantities are differences from the present prediction of the channel."""
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


def _weight(
    likelihood: Float[Array, " cells"],
    cells: Float[Array, "cells 3"],
    prior: Prior,
    belief: Belief | None,
    temper: float,
) -> Float[Array, " cells"]:
    return jax.nn.softmax(temper * likelihood + log_prior(cells, prior, belief))
