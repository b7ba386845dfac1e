"""The ensemble on what the closed form leaves, with the share of it that flight has borne out."""

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

KEPT = 0.9  # share of the evidence that is kept from fit to fit
DOUBT = 1.0  # [m^2/s^4], evidence that there is nothing to learn, before any flight


class LayeredState(eqx.Module):
    """Both states, and how well the ensemble has foretold what the closed form left."""

    first: RegressionState
    second: EnsembleState
    agreed: Float[Array, ""]
    """Forgetting sum of what was left times what had been foretold [m^2/s^4]."""
    foretold: Float[Array, ""]
    """The same of what had been foretold, squared."""
    smooth: Float[Array, ""]
    """Share of what was left in the last window that is no noise from tick to tick."""

    @property
    def share(self) -> Float[Array, ""]:
        """Share of the ensemble's prediction that is believed, between 0 and 1."""
        return self.smooth * jnp.clip(self.agreed / (self.foretold + DOUBT), 0.0, 1.0)


class LayeredModel(eqx.Module):
    """A closed form and an ensemble, as a :class:`retrim.learn.ResidualModel`.

    The ensemble is fitted to what the closed form leaves, and only to rows since the last change. Before each fit its
    prediction of the newest rows, which it has not seen, is compared with what was left there: the coefficient of a
    regression of the one on the other, between 0 and 1, is the share of it that counts. So an ensemble that was fitted
    across a change, or that knows nothing, does not make the layer below worse. Noise could pass this test, since what
    is noisy in a velocity is so in the input and in the target; but it jumps from tick to tick, and the share falls
    with how much of what is left does. Where members disagree, the mean is shrunk, per axis, by
    mean^2 / (mean^2 + spread^2).
    """

    first: RegressionModel
    second: EnsembleModel

    def init(self, key: Key[Array, ""]) -> LayeredState:
        """Return the prior of the one and fresh networks of the other; the key is consumed."""
        nothing = jnp.zeros(())
        return LayeredState(self.first.init(key), self.second.init(key), nothing, nothing, nothing)

    def fit(self, state: LayeredState, rows: Targets) -> tuple[LayeredState, Float[Array, ""]]:
        """Fit the closed form, weigh the ensemble by what it foretold, and fit it to the rest.

        Returns:
            The new state, and the weighted error of what both predict [m/s^2].
        """
        first, _, weight = self.first.fit_weighted(state.first, rows)
        left = rows.a_res - jax.vmap(lambda x, u: self.first.predict(first, x, u))(rows.x, rows.u)
        foretold = jax.vmap(lambda x, u: self._certain(state.second, x, u))(rows.x, rows.u)
        newest = (jnp.arange(weight.shape[0]) >= weight.shape[0] - BLOCK) & (weight > 0.0)
        agreed = KEPT * state.agreed + jnp.sum(jnp.where(newest, jnp.sum(left * foretold, axis=1), 0.0))
        squared = KEPT * state.foretold + jnp.sum(jnp.where(newest, jnp.sum(foretold**2, axis=1), 0.0))
        rest = Targets(rows.x, rows.u, left, rows.omega, weight > 0.0)
        second, _ = self.second.fit(state.second, rest)
        fitted = LayeredState(first, second, agreed, squared, _smooth(left, weight))
        error = left - fitted.share * jax.vmap(lambda x, u: self._certain(second, x, u))(rows.x, rows.u)
        mean_square = jnp.sum(weight * jnp.sum(error**2, axis=1)) / jnp.maximum(jnp.sum(weight), 1e-6)
        return where(jnp.any(weight > 0.0), fitted, state), jnp.sqrt(mean_square)

    def predict(self, state: LayeredState, x: State, u: Command) -> Float[Array, "3"]:
        """Return the prediction of the closed form and the share of the ensemble's [m/s^2]."""
        return self.first.predict(state.first, x, u) + state.share * self._certain(state.second, x, u)

    def spread(self, state: LayeredState, x: State, u: Command) -> Float[Array, "3"]:
        """Return the standard deviation of the prediction, both layers together [m/s^2]."""
        of_first, of_second = self.first.spread(state.first, x, u), self.second.spread(state.second, x, u)
        return jnp.sqrt(of_first**2 + (state.share * of_second) ** 2)

    def turning(self, state: LayeredState) -> RateFit:
        """Return what is known of how the vehicle turns."""
        return self.first.turning(state.first)

    def _certain(self, state: Any, x: State, u: Command) -> Float[Array, "3"]:
        """The mean of the members, shrunk where they disagree."""
        members = state.residual.members(x, u)
        squared = jnp.mean(members, axis=0) ** 2
        return jnp.mean(members, axis=0) * squared / (squared + jnp.var(members, axis=0) + 1e-9)


def _smooth(left: Float[Array, "n 3"], weight: Float[Array, " n"]) -> Float[Array, ""]:
    """One less the ratio of von Neumann: 1 for what hardly changes from row to row, 0 for white noise."""
    counts = (weight > 0.0).astype(left.dtype)
    jumps = 0.5 * jnp.sum(counts[1:] * counts[:-1] * jnp.sum(jnp.diff(left, axis=0) ** 2, axis=1))
    return jnp.clip(1.0 - jumps / (jnp.sum(counts * jnp.sum(left**2, axis=1)) + 1e-9), 0.0, 1.0)
