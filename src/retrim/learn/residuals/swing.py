"""A residual model for a vehicle with a load on a cable: another model, fitted to the remainder of the cable's pull.

The pull is not a function of state and command, since the load has its own state. In flight, the frame of the
effective gravity estimates the load in every tick and compensates its pull (:mod:`retrim.control.slung_load`). The
residual model must then not contain the pull: a window of a swinging load otherwise looks like a different drag or
thrust gain. Each fit therefore continues the same filter over the new rows of its window, and subtracts the pull.
"""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Key

from ...estimation.slung_load import Load, LoadEstimate
from ...physics import so3
from ...physics.state import Command, State, where
from .model import ResidualModel
from .rates import RateFit
from .targets import Targets

ROWS = 1024  # number of past rows whose pull is kept; longer windows are fitted to their newest rows
SETTLING = 0.6  # [s], time after which the filter knows the direction of the cable


class SwingState(eqx.Module):
    """State of the other model, and the load at the end of the last window."""

    first: Any
    load: LoadEstimate
    pulls: Float[Array, "m 3"]
    """Pull of the cable in past rows, newest last, world [m/s^2]."""
    fits: Int[Array, ""]
    """Number of fits so far. The first one uses its whole window; each later one continues with the new rows."""


class SwingModel(eqx.Module):
    """A residual model for a vehicle with a load, as a :class:`retrim.learn.ResidualModel`."""

    first: ResidualModel
    """Model of the acceleration that the nominal model misses without the load."""
    dt: float = eqx.field(static=True)
    """Control tick [s]."""
    every: float = eqx.field(static=True)
    """Time between fits [s]."""

    def init(self, key: Key[Array, ""]) -> SwingState:
        """Return the state before the first fit, which predicts zero; the key is consumed by the first model."""
        dtype = jnp.zeros(()).dtype
        pulls, fits = jnp.zeros((ROWS, 3), dtype=dtype), jnp.zeros((), dtype=jnp.int32)
        return SwingState(self.first.init(key), LoadEstimate.start(dtype), pulls, fits)

    def fit(self, state: SwingState, rows: Targets) -> tuple[SwingState, Float[Array, ""]]:
        """Estimate the load over the new rows, and fit the first model to the remainder of the pull."""
        n, count = rows.valid.shape[0], round(self.every / self.dt)
        before, pulls = state.pulls, jnp.zeros_like(state.pulls)
        pulls = pulls.at[: ROWS - count].set(before[count:]) if count < ROWS else pulls
        new = (jnp.arange(n - 1, -1, -1) < count) | (state.fits == 0)
        load, pulls = self._continue(state.load, pulls, rows, new)
        has_settled = (jnp.arange(n) > round(SETTLING / self.dt)) | (state.fits > 0)
        in_memory = jnp.arange(n - 1, -1, -1) < ROWS
        of_rows = jnp.concatenate([jnp.zeros((max(n - ROWS, 0), 3), dtype=pulls.dtype), pulls[-min(n, ROWS) :]])
        rest = dataclasses.replace(rows, a_res=rows.a_res - of_rows, valid=rows.valid & has_settled & in_memory)
        first, error = self.first.fit(state.first, rest)
        after = SwingState(first, load, pulls, state.fits + 1)
        return where(jnp.any(rest.valid), after, state), error

    def _continue(
        self, before: LoadEstimate, pulls: Float[Array, "m 3"], rows: Targets, new: Bool[Array, " n"]
    ) -> tuple[LoadEstimate, Float[Array, "m 3"]]:
        """Return the load after the new rows, and the pulls with those of the new rows."""
        v, n = rows.x.v, rows.valid.shape[0]
        after = jnp.concatenate([v[1:], v[-1:] + (v[-1:] - v[-2:-1])])
        middle = jax.vmap(lambda R, omega: so3.mul(R, so3.exp(0.5 * self.dt * omega)))(rows.x.R, rows.omega)
        noise = jnp.zeros((), dtype=v.dtype)

        def tick(s: LoadEstimate, row: tuple[Array, ...]) -> tuple[LoadEstimate, Array]:
            missed, v, after, thrust, valid, counts = row
            a = (after - v) / self.dt
            later = s.predict(a, self.dt).correct(missed, a, 0.5 * (v + after), thrust, noise, valid, self.dt)
            return where(counts, later, s), later.load.after(-0.5 * self.dt, a).pull(a)

        thrust = rows.u.c[:, None] * middle[:, :, 2]
        load, computed = lax.scan(tick, before, (rows.a_res, v, after, thrust, rows.valid, new))
        kept = min(n, ROWS)
        old = pulls[-kept:]
        return load, pulls.at[-kept:].set(jnp.where(new[-kept:, None], computed[-kept:], old))

    def predict(self, state: SwingState, x: State, u: Command) -> Float[Array, "3"]:
        """Return the prediction of the first model, without the pull, world [m/s^2]."""
        return self.first.predict(state.first, x, u)

    def load(self, state: SwingState) -> Load:
        """Return the load at the end of the last window: its mass and the length of the cable are learned in flight.

        Args:
            state: State of the model.
        """
        return state.load.load

    def turning(self, state: SwingState) -> RateFit | None:
        """Return the bias and lag of the body rates, if the first model identifies them."""
        turning = getattr(self.first, "turning", None)
        return None if turning is None else turning(state.first)
