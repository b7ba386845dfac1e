"""A residual that is linear in state and command, learned over the whole flight by recursive least squares."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key

from ...physics.state import STANDARD_GRAVITY, Command, State, where
from .linear_systems import solve_positive
from .targets import Targets

SIZE = 19
"""Number of features: constant (1), velocity (3), attitude (9), thrust vector beyond hover (3), body rates (3)."""
THRUST_SCALE = 3.0 / STANDARD_GRAVITY  # [s^2/m], scales thrust beyond hover to the size of the other features


class LinearState(eqx.Module):
    """Information from all rows so far, with exponential forgetting, and the resulting posterior."""

    precision: Float[Array, "19 19"]
    """Precision of the weights in units of their prior, excluding the precision of the prior itself."""
    moment: Float[Array, "19 3"]
    weights: Float[Array, "19 3"]
    """Weights of the features, for each axis."""
    covariance: Float[Array, "19 19"]
    """Covariance of the weights of one axis; the same for all three."""
    fits: Int[Array, ""]
    """Number of fits so far. The first uses its whole window; each later one uses only the new rows."""


class LinearModel(eqx.Module):
    """Ridge regression on 19 features, continued throughout the flight, as a :class:`retrim.learn.ResidualModel`.

    The weights of attitude-dependent wind, drag and thrust-map errors can only be distinguished by flight in many
    attitudes, which takes longer than a window. The information from each window is therefore added to that from
    earlier windows. The model predicts seconds ahead. For a recent change, use the closed form of
    :class:`~retrim.learn.residuals.regression.RegressionModel`, which has a short memory.
    """

    prior: Float[Array, "19"]
    """Standard deviations before any flight [m/s^2]: 5 for the constant, 0.3 for the others."""
    noise: Float[Array, ""]
    """Standard deviation of one row of targets [m/s^2]."""
    memory: Float[Array, ""]
    """Age at which a row's weight is 1/e of the newest row's weight [s]."""
    dt: float = eqx.field(static=True)
    """Control tick [s]."""
    every: float = eqx.field(static=True)
    """Time between fits, which is the length of the new part of each window [s]."""

    @classmethod
    def of(cls, dt: float, *, every: float, memory: float = 20.0, noise: float = 0.5) -> "LinearModel":
        """Return the model with default priors.

        Args:
            dt: Control tick [s].
            every: Time between fits [s].
            memory: Time constant of forgetting [s].
            noise: Standard deviation of one row of targets [m/s^2].
        """
        prior = jnp.full(SIZE, 0.3).at[0].set(5.0)
        return cls(prior, jnp.array(noise), jnp.array(memory), dt, every)

    def init(self, key: Key[Array, ""]) -> LinearState:
        """Return the state without information, which predicts zero; the key is not used."""
        del key
        nothing = jnp.zeros((SIZE, SIZE), dtype=self.prior.dtype)
        return self._solve(nothing, nothing[:, :3], jnp.zeros((), dtype=jnp.int32))

    def fit(self, state: LinearState, rows: Targets) -> tuple[LinearState, Float[Array, ""]]:
        """Add the new rows in ``rows`` (newest last); also return the root mean square error over all valid rows."""
        features = jax.vmap(features_of)(rows.x, rows.u) * self.prior[None]
        age = jnp.arange(rows.valid.shape[0] - 1, -1, -1)
        new = (age < round(self.every / self.dt)) | (state.fits == 0)
        since = self.dt * age.astype(features.dtype)
        weight = jnp.exp(-since / self.memory) * (rows.valid & new).astype(features.dtype) / self.noise**2
        decay = jnp.exp(-self.every / self.memory)
        result = self._solve(
            decay * state.precision + features.T @ (weight[:, None] * features),
            decay * state.moment + features.T @ (weight[:, None] * rows.a_res),
            state.fits + 1,
        )
        result = where(jnp.any(rows.valid), result, state)
        valid = rows.valid.astype(features.dtype)
        error = jnp.sum((rows.a_res - features @ (result.weights / self.prior[:, None])) ** 2, axis=1)
        return result, jnp.sqrt(jnp.sum(valid * error) / jnp.maximum(jnp.sum(valid), 1.0))

    def _solve(
        self, precision: Float[Array, "19 19"], moment: Float[Array, "19 3"], fits: Int[Array, ""]
    ) -> LinearState:
        """Return the state for the given information."""
        eye = jnp.eye(SIZE, dtype=precision.dtype)
        mean, covariance = solve_positive(eye + precision, moment, eye)
        weights, covariance = self.prior[:, None] * mean, self.prior[:, None] * covariance * self.prior[None]
        return LinearState(precision, moment, weights, covariance, fits)

    def predict(self, state: LinearState, x: State, u: Command) -> Float[Array, "3"]:
        """Return the mean prediction in the world frame [m/s^2]."""
        return features_of(x, u) @ state.weights

    def spread(self, state: LinearState, x: State, u: Command) -> Float[Array, "3"]:
        """Return the standard deviation of the prediction, without row noise; it is the same for all axes."""
        features = features_of(x, u)
        return jnp.broadcast_to(jnp.sqrt(features @ state.covariance @ features), (3,))


def features_of(x: State, u: Command) -> Float[Array, "19"]:
    """Return the features, which are all of order one in flight."""
    thrust = THRUST_SCALE * (u.c - STANDARD_GRAVITY) * x.R[:, 2]
    return jnp.concatenate([jnp.ones(1, dtype=x.p.dtype), x.v, x.R.reshape(9), thrust, u.omega])
