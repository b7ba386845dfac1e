"""Compute recursive sums for one channel of the command path: roll and pitch rates, yaw rate, or thrust.

A measurement is z = g h(theta) . f + D n + noise, with the features f of the commands, the response h from delay, lag
and damping (theta), the gain g, and further features n, for example the directions of a push. Sums of products of
whitened features and measurements are sufficient for every theta at once, so a grid does not need to be stored.
Measurements enter as differences from the present prediction, because single precision cannot represent the small
difference between large sums.
"""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .noise import KINDS, Whitening

GATE = 6.0  # standard deviations of the prediction beyond which a measurement does not count
JUMP = 10.0  # [m/s^2], standard deviation of the change in each component of a push that jumps
DOUBT_TAU, DOUBT_SHARE = 0.3, 0.5  # [s], and share of recent measurements beyond GATE that shows a wrong prediction


class Sample(eqx.Module):
    """One measurement of a channel."""

    value: Float[Array, " axes"]
    """Measured mean over ``width``, as a difference from hover."""
    other: Float[Array, "axes n"]
    """Features in addition to those of the commands."""
    usable: Bool[Array, ""]
    kinds: Float[Array, "kinds 3"]
    """Possible kinds of noise."""
    age: Float[Array, ""]
    """Time since the end of the averaging interval [s]."""
    width: Float[Array, ""]
    """Length of the averaging interval [s]; zero for an instantaneous value."""


class Coefficients(NamedTuple):
    """Normal distribution of the coefficients of other features."""

    mean: Float[Array, " n"]
    information: Float[Array, "n n"]
    """Inverse of the covariance."""


class Region(eqx.Module):
    """Ellipsoid of delay [s], logarithm of the lag [s], and ringing."""

    mean: Float[Array, "3"]
    covariance: Float[Array, "3 3"]


class PathPosterior(NamedTuple):
    """Weighted cells of the last grid."""

    cells: Float[Array, "cells 3"]
    """Delay [s], logarithm of the lag [s], ringing."""
    weight: Float[Array, " cells"]
    gain: Float[Array, " cells"]
    """Mean of the gain in each cell."""
    gain_variance: Float[Array, " cells"]
    response: Float[Array, " m"]
    """Mean of gain times response."""
    spread: Float[Array, "m m"]
    noise: Float[Array, ""]
    kind: Int[Array, ""]
    region: Region
    """Region of the next grid."""


class Channel(eqx.Module):
    """Sums of a channel, and the prediction of the next measurement."""

    whitening: Whitening
    products: Float[Array, "kinds axes columns columns"]
    """Sums of products of innovations: features of the commands, other features, misfit of the prediction."""
    half_log: Float[Array, " kinds"]
    """Half the sum of the logarithms of the innovations' variances."""
    count: Float[Array, ""]
    """Sum of the weights of the measurements."""
    squares: Float[Array, ""]
    """Sum of the squared weights."""
    response: Float[Array, " m"]
    """Gain times response of the present estimate."""
    spread: Float[Array, "m m"]
    """Covariance of ``response``."""
    other: Float[Array, "axes n"]
    """Coefficients of the other features in the present estimate."""
    other_spread: Float[Array, "axes n n"]
    """Covariance of ``other``."""
    noise: Float[Array, ""]
    """Standard deviation of the white noise."""
    kind: Int[Array, ""]
    """Index of the most likely kind of noise."""
    doubt: Float[Array, ""]
    """Share of recent measurements that are beyond :data:`GATE`."""
    age: Float[Array, ""]
    width: Float[Array, ""]
    region: Region
    """Region of the posterior."""

    @classmethod
    def start(
        cls,
        axes: int,
        others: Float[Array, " n"],
        response: Float[Array, " m"],
        spread: Float[Array, "m m"],
        noise: Float[Array, ""],
        region: Region,
    ) -> "Channel":
        """Return the channel before the first measurement.

        Args:
            axes: Number of axes that share all parameters except for their disturbances.
            others: Standard deviations of the coefficients of the other features.
            response: Mean of gain times response before any flight.
            spread: Covariance of ``response``.
            noise: Standard deviation of the noise before any flight.
            region: Region of the prior.
        """
        n, zero = others.shape[0], jnp.zeros(())
        columns = response.shape[0] + n + 1
        other_spread = jnp.tile(jnp.diag(others**2), (axes, 1, 1))
        return cls(
            Whitening.start(axes, columns), jnp.zeros((KINDS, axes, columns, columns)), jnp.zeros(KINDS),
            zero, zero, response, spread, jnp.zeros((axes, n)), other_spread,
            zero + noise, jnp.array(0), zero, zero, zero, region,
        )  # fmt: skip

    def observe(
        self,
        features: Float[Array, "axes m"],
        sample: Sample,
        keep: Float[Array, ""],
        dt: float,
        *,
        jumping: int = 0,
        jumped: Bool[Array, ""] | bool = False,
        model_error: Float[Array, ""] | float = 0.0,
    ) -> "Channel":
        """Return the channel after one tick.

        Args:
            features: Features of the commands of each axis.
            sample: The measurement; if it is not usable, only the time advances.
            keep: Remaining weight of earlier measurements.
            dt: Control tick [s].
            jumping: Number of leading other features whose coefficients jump with the disturbance, as the components of
                a push do; zero if the disturbance of the channel cannot jump.
            jumped: Whether other measurements show that the disturbance has jumped in this tick.
            model_error: Standard deviation of the error of the model in this tick, beyond the noise.
        """
        row = jnp.concatenate([features, sample.other, sample.value[:, None]], axis=1)
        extra = (model_error / self.noise) ** 2
        innovation, variance = self.whitening.innovation(row, sample.kinds, extra)
        m = self.response.shape[0]
        misfit = innovation[..., -1] - innovation[..., :m] @ self.response
        expected = variance[:, None] * self.noise**2 + jnp.einsum(
            "kai,ij,kaj->ka", innovation[..., :m], self.spread, innovation[..., :m]
        )
        others = innovation[self.kind, :, m:-1]
        left = misfit[self.kind] - jnp.sum(others * self.other, axis=1)
        allowed = expected[self.kind] + jnp.einsum("ai,aij,aj->a", others, self.other_spread, others)
        far = jnp.any(left**2 > GATE**2 * allowed)
        doubt = self.doubt + dt / DOUBT_TAU * (far.astype(keep.dtype) - self.doubt)
        doubt = jnp.where(sample.usable, doubt, self.doubt)
        counts = sample.usable & (~far | (self.doubt > DOUBT_SHARE))
        # The beginning of a push is not a property of the vehicle, so the disturbance is estimated again.
        jumps = jumped | (sample.usable & ~counts & (jumping > 0))
        weight = counts.astype(keep.dtype)
        column = jnp.concatenate([innovation[..., :-1], misfit[..., None]], axis=2)
        column = jnp.where(counts, column, 0.0) / jnp.sqrt(variance)[:, None, None]
        axes, products, other_spread = row.shape[0], keep * self.products, self.other_spread
        for i in range(jumping):
            products = jnp.where(jumps, integrate_out(products, m + i, (self.noise / JUMP) ** 2), products)
            other_spread = other_spread.at[:, i, i].add(jnp.where(jumps, JUMP**2, 0.0))
        return Channel(
            self.whitening.after(innovation, sample.kinds, counts, jumps, extra),
            products + column[..., :, None] * column[..., None, :],
            keep * self.half_log + weight * 0.5 * axes * jnp.log(variance),
            keep * self.count + weight * axes,
            keep**2 * self.squares + weight * axes,
            self.response, self.spread, self.other, other_spread, self.noise, self.kind, doubt,
            jnp.where(sample.usable, sample.age, self.age), jnp.where(sample.usable, sample.width, self.width),
            self.region,
        )  # fmt: skip

    @property
    def temper(self) -> Float[Array, ""]:
        """Factor on the sums that corrects the information for forgetting: old measurements count only in part."""
        return self.count / jnp.maximum(self.squares, 1.0)

    def predict(self, posterior: PathPosterior, others: Coefficients) -> "Channel":
        """Return the channel with a new prediction, and with its sums relative to that prediction.

        Args:
            posterior: Posterior of the channel.
            others: Distribution of the coefficients of the other features without the sums.
        """
        m = self.response.shape[0]
        change = posterior.response - self.response
        misfit = self.products[..., -1] - self.products[..., :m] @ change
        last = misfit[..., -1:] - misfit[..., :m] @ change[:, None]
        side = misfit[..., :-1, None]
        below = jnp.concatenate([misfit[..., :-1], last], axis=-1)[..., None, :]
        products = jnp.concatenate([jnp.concatenate([self.products[..., :-1, :-1], side], axis=-1), below], axis=-2)
        n = others.mean.shape[0]
        sums = with_coefficients(self.temper * products[posterior.kind], others, posterior.noise)[:, m:, m:]
        other_spread = jnp.linalg.inv(sums[:, :n, :n] / posterior.noise**2)
        return dataclasses.replace(
            self,
            other=jnp.einsum("aij,aj->ai", other_spread, sums[:, :n, -1]) / posterior.noise**2,
            other_spread=other_spread,
            products=products,
            response=posterior.response,
            spread=posterior.spread,
            noise=posterior.noise,
            kind=posterior.kind,
            region=posterior.region,
        )


def with_coefficients(
    products: Float[Array, "*parts columns columns"], others: Coefficients, noise: Float[Array, ""]
) -> Float[Array, "*parts columns columns"]:
    """Return the sums with the information about the coefficients of the other features.

    Args:
        products: Sums of products.
        others: Distribution of the coefficients.
        noise: Standard deviation of the white noise, the unit of the sums.
    """
    n = others.mean.shape[0]
    middle = slice(products.shape[-1] - 1 - n, products.shape[-1] - 1)
    alike = noise**2 * others.information
    side = alike @ others.mean
    products = products.at[..., middle, middle].add(alike)
    products = products.at[..., middle, -1].add(side).at[..., -1, middle].add(side)
    return products.at[..., -1, -1].add(others.mean @ side)


def integrate_out(
    products: Float[Array, "*parts columns columns"], i: int, before: Float[Array, ""] | float = 0.0
) -> Float[Array, "*parts columns columns"]:
    """Return the sums without the information about the coefficient of column ``i``.

    Args:
        products: Sums of products.
        i: Column of the feature.
        before: Information about the coefficient in addition to the sums, in units of the sums.
    """
    row = products[..., i, :]
    pivot = row[..., i] + before
    return products - row[..., :, None] * row[..., None, :] / pivot[..., None, None]
