"""What foretells the residual acceleration of the next seconds: yardsticks, and residual models of every name."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jax import random
from jaxtyping import Array, Float

from ..adapt.gate import all_finite
from ..config.loading import changed
from ..config.presets import Preset
from ..config.residuals import ResidualRequest, make_residual
from ..learn.residuals.model import ResidualModel
from ..learn.residuals.targets import Targets
from ..physics.state import STANDARD_GRAVITY
from ..physics.vehicle import Vehicle

Predict = Callable[[Targets], np.ndarray]
Predictor = Callable[[Targets], Predict]
"""Fits to the rows of the last seconds, the newest last; returns the prediction at further rows [m/s^2]."""
RIDGE = 10.0  # penalty of the sum of squares
STEEP = 3.0  # [m/s^2] of thrust that count as one


def zero(rows: Targets) -> Predict:
    """Foretell nothing."""
    return lambda more: np.zeros(more.a_res.shape)


def mean_of(rows: Targets, ticks: int | None = None) -> Predict:
    """Foretell the mean of the last ticks, or of all."""
    chosen = jax.tree.map(lambda leaf: leaf[-ticks:] if ticks else leaf, rows)
    valid = np.asarray(chosen.valid)
    mean = np.asarray(chosen.a_res)[valid].mean(axis=0) if valid.any() else np.zeros(3)
    return lambda more: np.broadcast_to(mean, more.a_res.shape)


def ridge(rows: Targets) -> Predict:
    """Foretell by ridge regression of this window alone on velocity, attitude, thrust and body rates."""
    valid = np.asarray(rows.valid)
    X, Y = _inputs(rows)[valid], np.asarray(rows.a_res, dtype=float)[valid]
    mean, level = X.mean(axis=0), Y.mean(axis=0)
    Z = X - mean
    weights = np.linalg.solve(Z.T @ Z + RIDGE * np.eye(Z.shape[1]), Z.T @ (Y - level))
    return lambda more: level + (_inputs(more) - mean) @ weights


def _inputs(rows: Targets) -> np.ndarray:
    n = rows.valid.shape[0]
    thrust = (np.asarray(rows.u.c)[:, None] - STANDARD_GRAVITY) / STEEP
    columns = [rows.x.v, np.asarray(rows.x.R).reshape(n, 9), thrust, rows.u.omega]
    return np.concatenate([np.asarray(column, dtype=float) for column in columns], axis=1)


class Learnt:
    """A residual model, refitted from where the last fit ended, as in flight."""

    def __init__(self, model: ResidualModel, seed: int) -> None:
        self._model, self._state = model, model.init(random.key(seed))

    def __call__(self, rows: Targets) -> Predict:
        """Fit to a window."""
        state = refitted(self._model, self._state, rows)
        if bool(all_finite(eqx.filter(state, eqx.is_inexact_array))):  # a fit that is not is refused in flight
            self._state = state
        kept = self._state
        return lambda more: np.asarray(_predicted(self._model, kept, more))


@eqx.filter_jit
def refitted(model: ResidualModel, state: Any, rows: Targets) -> Any:
    """Return the state of a residual model after a fit, by a program that models of one kind share."""
    return model.fit(state, rows)[0]


@eqx.filter_jit
def _predicted(model: ResidualModel, state: Any, rows: Targets) -> Float[Array, "n 3"]:
    predicted: Float[Array, "n 3"] = jax.vmap(lambda x, u: model.predict(state, x, u))(rows.x, rows.u)
    return predicted


def yardsticks(dt: float) -> dict[str, Callable[[], Predictor]]:
    """Return what learning is measured by."""
    second = max(1, round(1.0 / dt))
    return {
        "zero": lambda: zero,
        "last second": lambda: lambda rows: mean_of(rows, second),
        "mean of the buffer": lambda: mean_of,
        "ridge": lambda: ridge,
    }


def learnt(name: str, preset: Preset, vehicle: Vehicle, seed: int, **adapt: Any) -> Callable[[], Predictor]:
    """Return how to begin a residual model of a preset anew.

    Args:
        name: Of the residual model, or module:name.
        preset: Its settings.
        vehicle: Its limits.
        seed: Of fresh networks.
        **adapt: Values of the preset's table ``adapt``, on top of it.

    Raises:
        ConfigError: There is none of that name, or a value cannot be.
    """
    model = make_residual(ResidualRequest(changed(preset, adapt={"residual": name, **adapt}), vehicle))
    return lambda: Learnt(model, seed)
