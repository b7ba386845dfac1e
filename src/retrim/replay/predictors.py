"""Predicts the residual acceleration over the next few seconds, with baselines and with residual models by name."""

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
"""Fits to the rows of the last few seconds, in order of time; returns a predictor for further rows [m/s^2]."""
RIDGE = 10.0  # penalty, added to the sums of squares
THRUST_UNIT = 3.0  # thrust [m/s^2] that corresponds to one unit of the regression input


def zero(rows: Targets) -> Predict:
    """Predict zero."""
    return lambda more: np.zeros(more.a_res.shape)


def mean_of(rows: Targets, ticks: int | None = None) -> Predict:
    """Predict the mean of the last ``ticks``, or of all rows."""
    used_rows = jax.tree.map(lambda leaf: leaf[-ticks:] if ticks else leaf, rows)
    valid = np.asarray(used_rows.valid)
    mean = np.asarray(used_rows.a_res)[valid].mean(axis=0) if valid.any() else np.zeros(3)
    return lambda more: np.broadcast_to(mean, more.a_res.shape)


def ridge(rows: Targets) -> Predict:
    """Predict by ridge regression on the velocity, attitude, thrust and body rates in this window only."""
    valid = np.asarray(rows.valid)
    X, Y = _inputs(rows)[valid], np.asarray(rows.a_res, dtype=float)[valid]
    mean, level = X.mean(axis=0), Y.mean(axis=0)
    Z = X - mean
    weights = np.linalg.solve(Z.T @ Z + RIDGE * np.eye(Z.shape[1]), Z.T @ (Y - level))
    return lambda more: level + (_inputs(more) - mean) @ weights


def _inputs(rows: Targets) -> np.ndarray:
    n = rows.valid.shape[0]
    thrust = (np.asarray(rows.u.c)[:, None] - STANDARD_GRAVITY) / THRUST_UNIT
    columns = [rows.x.v, np.asarray(rows.x.R).reshape(n, 9), thrust, rows.u.omega]
    return np.concatenate([np.asarray(column, dtype=float) for column in columns], axis=1)


class LearningPredictor:
    """A residual model; each fit starts from the result of the previous one, as in flight."""

    def __init__(self, model: ResidualModel, seed: int) -> None:
        self._model, self._state = model, model.init(random.key(seed))

    def __call__(self, rows: Targets) -> Predict:
        """Fit to a window, and return its predictor."""
        state = refit(self._model, self._state, rows)
        if bool(all_finite(eqx.filter(state, eqx.is_inexact_array))):  # in flight, a fit that is not finite is refused
            self._state = state
        state_before = self._state
        return lambda more: np.asarray(_predict(self._model, state_before, more))


@eqx.filter_jit
def refit(model: ResidualModel, state: Any, rows: Targets) -> Any:
    """Return a residual model's state after a fit; models of the same kind share the compiled program."""
    return model.fit(state, rows)[0]


@eqx.filter_jit
def _predict(model: ResidualModel, state: Any, rows: Targets) -> Float[Array, "n 3"]:
    predictions: Float[Array, "n 3"] = jax.vmap(lambda x, u: model.predict(state, x, u))(rows.x, rows.u)
    return predictions


def yardsticks(dt: float) -> dict[str, Callable[[], Predictor]]:
    """Return the baselines for residual models."""
    second = max(1, round(1.0 / dt))
    return {
        "zero": lambda: zero,
        "last second": lambda: lambda rows: mean_of(rows, second),
        "mean of the buffer": lambda: mean_of,
        "ridge": lambda: ridge,
    }


def model_factory(name: str, preset: Preset, vehicle: Vehicle, seed: int, **adapt: Any) -> Callable[[], Predictor]:
    """Return a factory for one of a preset's residual models.

    Args:
        name: Name of the residual model, or module:name.
        preset: Settings of the model.
        vehicle: Vehicle whose limits apply.
        seed: Seed for the initial networks.
        **adapt: Values that override those in the preset's ``adapt`` table.

    Raises:
        ConfigError: There is no model with that name, or a value is invalid.
    """
    model = make_residual(ResidualRequest(changed(preset, adapt={"residual": name, **adapt}), vehicle))
    return lambda: LearningPredictor(model, seed)
