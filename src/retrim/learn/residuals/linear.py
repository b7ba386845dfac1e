"""A residual that is linear in state and command, learnt over the whole flight: recursive least squares."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key

from ...physics.state import STANDARD_GRAVITY, Command, State, where
from .targets import Targets

SIZE = 19
"""Features: one (1), velocity (3), attitude (9), thrust beyond hover along its axis (3), body rates (3)."""
STEEP = 3.0 / STANDARD_GRAVITY  # [s^2/m]: thrust beyond hover has the size of the other features


class LinearState(eqx.Module):
    """Information of all rows so far, the older ones forgotten exponentially, and what follows from it."""

    precision: Float[Array, "19 19"]
    """Of the weights in units of their prior, which is not in it."""
    moment: Float[Array, "19 3"]
    weights: Float[Array, "19 3"]
    """Of the features, for each axis."""
    covariance: Float[Array, "19 19"]
    """Of the weights of one axis; the same for all three."""
    fits: Int[Array, ""]
    """How many fits there were: the first counts all of its window, each later one what is new in it."""


class LinearModel(eqx.Module):
    """Ridge regression on 19 features, carried along the flight, as a :class:`retrim.learn.ResidualModel`.

    The weights of a wind that depends on the attitude, of drag and of an error of the thrust map can only be told from
    each other by flight in many attitudes, which takes longer than a window. So what a window says is added to what
    the earlier ones said. It foretells seconds ahead; for a change that just happened use the closed form of
    :class:`~retrim.learn.residuals.regression.RegressionModel`, whose memory is short.
    """

    prior: Float[Array, "19"]
    """Standard deviations before any flight [m/s^2]; of the constant 5, of the others .3."""
    noise: Float[Array, ""]
    """Standard deviation of one row of targets [m/s^2]."""
    memory: Float[Array, ""]
    """A row counts for 1/e of the newest after this long [s]."""
    dt: float = eqx.field(static=True)
    """Control tick [s]."""
    every: float = eqx.field(static=True)
    """Time between fits [s]: that much of each window is new."""

    @classmethod
    def of(cls, dt: float, *, every: float, memory: float = 20.0, noise: float = 0.5) -> "LinearModel":
        """Return the model.

        Args:
            dt: Control tick [s].
            every: Time between fits [s].
            memory: Time constant of forgetting [s].
            noise: Standard deviation of one row of targets [m/s^2].
        """
        prior = jnp.full(SIZE, 0.3).at[0].set(5.0)
        return cls(prior, jnp.array(noise), jnp.array(memory), dt, every)

    def init(self, key: Key[Array, ""]) -> LinearState:
        """Return no information, which predicts zero; the key is not needed."""
        del key
        nothing = jnp.zeros((SIZE, SIZE), dtype=self.prior.dtype)
        return self._solved(nothing, nothing[:, :3], jnp.zeros((), dtype=jnp.int32))

    def fit(self, state: LinearState, rows: Targets) -> tuple[LinearState, Float[Array, ""]]:
        """Add what is new in ``rows``, the newest last; also return the root mean square error over all valid ones."""
        features = jax.vmap(features_of)(rows.x, rows.u) * self.prior[None]
        age = jnp.arange(rows.valid.shape[0] - 1, -1, -1)
        new = (age < round(self.every / self.dt)) | (state.fits == 0)
        since = self.dt * age.astype(features.dtype)
        weight = jnp.exp(-since / self.memory) * (rows.valid & new).astype(features.dtype) / self.noise**2
        kept = jnp.exp(-self.every / self.memory)
        fitted = self._solved(
            kept * state.precision + features.T @ (weight[:, None] * features),
            kept * state.moment + features.T @ (weight[:, None] * rows.a_res),
            state.fits + 1,
        )
        fitted = where(jnp.any(rows.valid), fitted, state)
        valid = rows.valid.astype(features.dtype)
        error = jnp.sum((rows.a_res - features @ (fitted.weights / self.prior[:, None])) ** 2, axis=1)
        return fitted, jnp.sqrt(jnp.sum(valid * error) / jnp.maximum(jnp.sum(valid), 1.0))

    def _solved(
        self, precision: Float[Array, "19 19"], moment: Float[Array, "19 3"], fits: Int[Array, ""]
    ) -> LinearState:
        """Return the state of that information."""
        eye = jnp.eye(SIZE, dtype=precision.dtype)
        factor = jax.scipy.linalg.cho_factor(eye + precision)
        weights = self.prior[:, None] * jax.scipy.linalg.cho_solve(factor, moment)
        covariance = self.prior[:, None] * jax.scipy.linalg.cho_solve(factor, eye) * self.prior[None]
        return LinearState(precision, moment, weights, covariance, fits)

    def predict(self, state: LinearState, x: State, u: Command) -> Float[Array, "3"]:
        """Return the mean prediction, world frame [m/s^2]."""
        return features_of(x, u) @ state.weights

    def spread(self, state: LinearState, x: State, u: Command) -> Float[Array, "3"]:
        """Return the standard deviation of the prediction, without that of a single row; the same for all axes."""
        features = features_of(x, u)
        return jnp.broadcast_to(jnp.sqrt(features @ state.covariance @ features), (3,))


def features_of(x: State, u: Command) -> Float[Array, "19"]:
    """Return the features, all about of order one in flight."""
    thrust = STEEP * (u.c - STANDARD_GRAVITY) * x.R[:, 2]
    return jnp.concatenate([jnp.ones(1, dtype=x.p.dtype), x.v, x.R.reshape(9), thrust, u.omega])
