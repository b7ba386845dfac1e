"""Fit an ensemble to the remainder of the closed form, weighted by the share of its prediction that flight confirms."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from ...physics.state import Command, State, where
from .ensemble import EnsembleModel, EnsembleState
from .rates import RateFit
from .regression import BLOCK, RegressionModel, RegressionState
from .targets import Targets

DECAY = 0.9  # share of the evidence that is kept from fit to fit
DOUBT = 1.0  # [m^2/s^4], prior evidence for a share of zero, before any flight


class LayeredState(eqx.Module):
    """The states of both layers, and how well the ensemble has predicted the remainder of the closed form."""

    first: RegressionState
    second: EnsembleState
    agreement: Float[Array, ""]
    """Sum, with exponential forgetting, of remainder times prediction [m^2/s^4]."""
    power: Float[Array, ""]
    """Sum, with exponential forgetting, of the squared prediction [m^2/s^4]."""
    smooth: Float[Array, ""]
    """Share of the remainder in the last window that is not tick-to-tick noise."""

    @property
    def share(self) -> Float[Array, ""]:
        """Share of the ensemble's prediction that is used, between 0 and 1."""
        return self.smooth * jnp.clip(self.agreement / (self.power + DOUBT), 0.0, 1.0)


class LayeredModel(eqx.Module):
    """A closed form with an ensemble on top, as a :class:`retrim.learn.ResidualModel`.

    The ensemble is fitted to the remainder of the closed form, and only to rows since the last change. Before each fit,
    its prediction for the newest rows, which were not in its training data, is compared with their remainder. The
    remainder is regressed on the prediction; the coefficient, between 0 and 1, is the share of the prediction that is
    used. An ensemble that was fitted across a change, or without useful data, therefore does not make the closed form
    worse. Noise could pass this test, since velocity noise enters both the input and the target. But noise jumps from
    tick to tick, and the share decreases with the part of the remainder that jumps. Where members disagree, the mean is
    shrunk, per axis, by the factor mean^2 / (mean^2 + spread^2).
    """

    first: RegressionModel
    second: EnsembleModel

    def init(self, key: Key[Array, ""]) -> LayeredState:
        """Return the prior of the closed form and fresh networks for the ensemble; the key is consumed."""
        nothing = jnp.zeros(())
        return LayeredState(self.first.init(key), self.second.init(key), nothing, nothing, nothing)

    def fit(self, state: LayeredState, rows: Targets) -> tuple[LayeredState, Float[Array, ""]]:
        """Fit the closed form, weight the ensemble by its last prediction, and fit the ensemble to the remainder.

        Returns:
            The new state, and the weighted error of the joint prediction [m/s^2].
        """
        first, _, weight = self.first.fit_weighted(state.first, rows)
        left = rows.a_res - jax.vmap(lambda x, u: self.first.predict(first, x, u))(rows.x, rows.u)
        prediction = jax.vmap(lambda x, u: self._certain(state.second, x, u))(rows.x, rows.u)
        newest = (jnp.arange(weight.shape[0]) >= weight.shape[0] - BLOCK) & (weight > 0.0)
        agreement = DECAY * state.agreement + jnp.sum(jnp.where(newest, jnp.sum(left * prediction, axis=1), 0.0))
        square = DECAY * state.power + jnp.sum(jnp.where(newest, jnp.sum(prediction**2, axis=1), 0.0))
        rest = Targets(rows.x, rows.u, left, rows.omega, weight > 0.0)
        second, _ = self.second.fit(state.second, rest)
        result = LayeredState(first, second, agreement, square, _smooth(left, weight))
        error = left - result.share * jax.vmap(lambda x, u: self._certain(second, x, u))(rows.x, rows.u)
        mean_square = jnp.sum(weight * jnp.sum(error**2, axis=1)) / jnp.maximum(jnp.sum(weight), 1e-6)
        return where(jnp.any(weight > 0.0), result, state), jnp.sqrt(mean_square)

    def predict(self, state: LayeredState, x: State, u: Command) -> Float[Array, "3"]:
        """Return the closed form's prediction plus the used share of the ensemble's [m/s^2]."""
        return self.first.predict(state.first, x, u) + state.share * self._certain(state.second, x, u)

    def spread(self, state: LayeredState, x: State, u: Command) -> Float[Array, "3"]:
        """Return the standard deviation of the joint prediction of both layers [m/s^2]."""
        of_first, of_second = self.first.spread(state.first, x, u), self.second.spread(state.second, x, u)
        return jnp.sqrt(of_first**2 + (state.share * of_second) ** 2)

    def turning(self, state: LayeredState) -> RateFit:
        """Return the identified bias and lag of the body rates."""
        return self.first.turning(state.first)

    def _certain(self, state: Any, x: State, u: Command) -> Float[Array, "3"]:
        """Return the mean of the members, shrunk where they disagree."""
        members = state.residual.members(x, u)
        square = jnp.mean(members, axis=0) ** 2
        return jnp.mean(members, axis=0) * square / (square + jnp.var(members, axis=0) + 1e-9)


def _smooth(left: Float[Array, "n 3"], weight: Float[Array, " n"]) -> Float[Array, ""]:
    """Return one minus the von Neumann ratio: 1 for a remainder that hardly changes between rows, 0 for white noise."""
    counts = (weight > 0.0).astype(left.dtype)
    jumps = 0.5 * jnp.sum(counts[1:] * counts[:-1] * jnp.sum(jnp.diff(left, axis=0) ** 2, axis=1))
    return jnp.clip(1.0 - jumps / (jnp.sum(counts * jnp.sum(left**2, axis=1)) + 1e-9), 0.0, 1.0)
