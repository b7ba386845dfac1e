"""A closed-form residual: Bayesian linear regression on physical features, with exponential forgetting."""

import dataclasses
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key

from ...physics import so3
from ...physics.actuators import is_unsaturated
from ...physics.state import STANDARD_GRAVITY, Command, State, where
from .linear_systems import solve_positive
from .rates import RateFit, RateModel
from .targets import Targets

SIZE = 10
"""Number of parameters: constant push (3), thrust gain (1), linear drag (3), quadratic drag (3)."""
BLOCK = 8
"""Number of rows that are compared at once in the search for a change."""
TAIL = 4.0
"""Error in standard deviations beyond which a row loses weight (Huber's likelihood)."""
PASSES = 2
"""Passes of iteratively reweighted least squares. Gross errors are excluded beforehand, so a few passes are enough."""
SURPRISE = 21.1
"""Threshold that a chi-squared variable with three degrees of freedom exceeds once in 10,000 times."""


class Normal(NamedTuple):
    """A normal distribution of the parameters."""

    mean: Float[Array, "10"]
    covariance: Float[Array, "10 10"]


class RegressionState(eqx.Module):
    """Normal posterior of the parameters."""

    mean: Float[Array, "10"]
    covariance: Float[Array, "10 10"]
    rates: RateFit
    """Bias and lag of the body rates."""


class RegressionModel(eqx.Module):
    """The residual with ten physical parameters, as a :class:`retrim.learn.ResidualModel`.

    a_res = d + R (k_c (c - g) e3 - k_1 v_b - k_2 |v_b| v_b), where v_b is the velocity in the body frame and the
    products are per axis. The thrust gain k_c acts on the thrust beyond hover, since at hover it cannot be
    distinguished from a push along z, which is part of d. A fit is exact, takes less than a millisecond, and depends on
    the window alone, not on earlier fits.

    Rows whose command is at a limit do not count: a gain that explains a mixer's output there would reverse the effect
    of thrust. The likelihood has heavy tails: a row with an error of more than four standard deviations counts less. A
    window without such rows has the same fit as with a normal likelihood.
    """

    prior: Float[Array, "10"]
    """Standard deviations before any flight: [m/s^2] x 3, [-], [1/s] x 3, [1/m] x 3."""
    noise: Float[Array, ""]
    """Standard deviation of one row of targets [m/s^2]."""
    memory: Float[Array, ""]
    """Age at which a row's weight is 1/e of the newest row's weight [s]."""
    rates: RateModel
    """Model of the body-rate errors, which are not accelerations and are identified separately."""
    dt: float = eqx.field(static=True)
    """Control tick [s]."""
    limits: tuple[Command, Command] | None = None
    """Smallest and largest command; None if commands are not limited."""

    @classmethod
    def of(
        cls,
        dt: float,
        *,
        memory: float = 0.5,
        noise: float = 0.5,
        thrust_prior: float = 0.05,
        tau: tuple[float, float, float] = (0.03,) * 3,
        limits: tuple[Command, Command] | None = None,
    ) -> "RegressionModel":
        """Return the model with priors for small and medium quadrotors.

        Args:
            dt: Control tick [s].
            memory: Time constant of forgetting [s].
            noise: Standard deviation of one row of targets [m/s^2], due to sensor noise and unmodelled effects.
            thrust_prior: Standard deviation of the thrust gain [-].
            tau: Most likely time constants of the body rates [s].
            limits: Smallest and largest command; None if commands are not limited.
        """
        prior = jnp.array([5.0, 5.0, 5.0, thrust_prior, 0.3, 0.3, 0.3, 0.03, 0.03, 0.03])
        return cls(prior, jnp.array(noise), jnp.array(memory), RateModel.of(dt, memory=memory, tau=tau), dt, limits)

    def init(self, key: Key[Array, ""]) -> RegressionState:
        """Return the prior, which predicts zero; the key is not used."""
        del key
        return RegressionState(jnp.zeros_like(self.prior), jnp.diag(self.prior**2), self.rates.init())

    def fit(self, state: RegressionState, rows: Targets) -> tuple[RegressionState, Float[Array, ""]]:
        """Return the posterior given ``rows`` (newest last), and the weighted error [m/s^2].

        The precision is diag(1 / prior^2) + sum_i w_i Phi_i^T Phi_i / noise^2. w_i falls exponentially with age, and is
        zero for rows before a change. To find a change, the newest block of rows predicts each older block. The first
        block that the newest one does not explain (at 99.99 %) and all older blocks do not count.
        """
        result, rms, _ = self.fit_weighted(state, rows)
        return result, rms

    def fit_weighted(
        self, state: RegressionState, rows: Targets
    ) -> tuple[RegressionState, Float[Array, ""], Float[Array, " n"]]:
        """Fit like :meth:`fit`; also return each row's weight, which is zero for invalid rows and before a change."""
        if self.limits is not None:
            unsaturated = jax.vmap(partial(is_unsaturated, limits=self.limits))(rows.u)
            rows = dataclasses.replace(rows, valid=rows.valid & unsaturated)
        features = jax.vmap(features_of)(rows.x, rows.u)
        weight = self._weight(features, rows)
        posterior = self._posterior(features, rows.a_res, weight)
        for _ in range(PASSES):
            posterior = self._posterior(features, rows.a_res, weight * self._tail(features, rows, weight, posterior))
        error = jnp.sum((rows.a_res - features @ posterior.mean) ** 2, axis=1)
        rms = jnp.sqrt(jnp.sum(weight * error) / jnp.maximum(jnp.sum(weight), 1e-6))
        result = RegressionState(posterior.mean, posterior.covariance, self.rates.fit(rows))
        return where(jnp.any(rows.valid), result, state), rms, weight

    def _weight(self, features: Float[Array, "n 3 10"], rows: Targets) -> Float[Array, " n"]:
        age = jnp.arange(rows.valid.shape[0] - 1, -1, -1)
        valid = rows.valid.astype(rows.a_res.dtype)
        recent = self._posterior(features, rows.a_res, jnp.where(age < BLOCK, valid, 0.0))
        newer = self._weigh_changes(recent, features, rows.a_res, valid, age // BLOCK)
        return jnp.exp(-self.dt * age.astype(valid.dtype) / self.memory) * valid * newer

    def _tail(
        self, features: Float[Array, "n 3 10"], rows: Targets, weight: Float[Array, " n"], posterior: Normal
    ) -> Float[Array, " n"]:
        """Return the factor of each row's weight: one within the limit, falling with the square of the error beyond."""
        errors = jnp.sqrt(jnp.sum((rows.a_res - features @ posterior.mean) ** 2, axis=1))
        count = jnp.sum(weight > 0.0)
        order = jnp.sort(jnp.where(weight > 0.0, errors, jnp.inf))
        median = jnp.where(count > 0, order[jnp.maximum(count // 2, 1) - 1], 0.0)
        limit = TAIL * jnp.maximum(self.noise, median)
        return jnp.where(errors > limit, (limit / jnp.maximum(errors, limit)) ** 2, 1.0)

    def _posterior(
        self, features: Float[Array, "n 3 10"], target: Float[Array, "n 3"], weight: Float[Array, " n"]
    ) -> Normal:
        scaled_features = (
            features * self.prior[None, None]
        )  # parameters of order one: well conditioned in single precision
        eye = jnp.eye(SIZE, dtype=scaled_features.dtype)
        precision = eye + jnp.einsum("n,nik,nil->kl", weight, scaled_features, scaled_features) / self.noise**2
        moment = jnp.einsum("n,nik,ni->k", weight, scaled_features, target) / self.noise**2
        mean, covariance = solve_positive(precision, moment, eye)
        return Normal(self.prior * mean, self.prior[:, None] * covariance * self.prior[None])

    def _weigh_changes(
        self,
        recent: Normal,
        features: Float[Array, "n 3 10"],
        target: Float[Array, "n 3"],
        valid: Float[Array, " n"],
        block: Int[Array, " n"],
    ) -> Float[Array, " n"]:
        """Return one for rows since the last change, else zero; ``block`` counts blocks of rows from the newest."""
        blocks = -(-target.shape[0] // BLOCK)
        count = jax.ops.segment_sum(valid, block, blocks)
        per = jnp.maximum(count, 1.0)
        errors = jax.ops.segment_sum(valid[:, None] * (target - features @ recent.mean), block, blocks) / per[:, None]
        mean = jax.ops.segment_sum(valid[:, None, None] * features, block, blocks) / per[:, None, None]
        of_row = (self.noise**2 / per)[:, None, None] * jnp.eye(3, dtype=target.dtype)[None]
        expected = jnp.einsum("bik,kl,bjl->bij", mean, recent.covariance, mean) + of_row
        surprise = jnp.einsum("bi,bij,bj->b", errors, jnp.linalg.inv(expected), errors)
        is_explained = (surprise < SURPRISE) | (count == 0)
        since: Float[Array, " b"] = jnp.cumprod(is_explained.astype(target.dtype))
        return since[block]

    def predict(self, state: RegressionState, x: State, u: Command) -> Float[Array, "3"]:
        """Return the mean prediction in the world frame [m/s^2]."""
        return features_of(x, u) @ state.mean

    def turning(self, state: RegressionState) -> RateFit:
        """Return the identified bias and lag of the body rates."""
        return state.rates

    def spread(self, state: RegressionState, x: State, u: Command) -> Float[Array, "3"]:
        """Return the standard deviation of the prediction, without row noise [m/s^2]."""
        features = features_of(x, u)
        return jnp.sqrt(jnp.sum((features @ state.covariance) * features, axis=1))


def features_of(x: State, u: Command) -> Float[Array, "3 10"]:
    """Return the features Phi in the world frame; the residual is Phi times the ten parameters."""
    v_b = so3.act(x.R.T, x.v)
    push = jnp.eye(3, dtype=x.p.dtype)
    gain = x.R[:, 2:] * (u.c - STANDARD_GRAVITY)
    return jnp.concatenate([push, gain, -x.R * v_b[None], -x.R * (jnp.abs(v_b) * v_b)[None]], axis=1)
