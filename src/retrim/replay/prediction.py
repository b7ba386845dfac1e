"""Measures how well the last few seconds of a log predict the next few."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import jax
import numpy as np

from ..errors import LogError
from ..learn.residuals.targets import Targets
from .predictors import Predictor

FIT_PERIOD = 3.0  # time between fits [s], as in the paper
LEAST_VALID = 0.5  # share of a buffer or a horizon that must be valid


@dataclass(frozen=True)
class PredictionScore:
    """Prediction errors of one predictor on one log."""

    name: str
    rmse: float
    """Root of the mean squared error, averaged over windows and summed over axes [m/s^2]."""
    per_axis: tuple[float, float, float]
    """Error along the world axes x, y, z [m/s^2]."""
    per_window: tuple[float, ...]
    """Root of each window's mean squared error, summed over axes [m/s^2]."""
    times: tuple[float, ...]
    """Time of each prediction, from the beginning of the log [s]."""


@dataclass(frozen=True)
class Protocol:
    """Lengths of the fitted and the predicted windows."""

    buffer: float = 5.0
    """Length of the fitted window [s]."""
    horizon: float = 5.0
    """Length of the predicted window [s]."""
    every: float = FIT_PERIOD
    """Time between fits [s]."""

    def windows(self, valid: np.ndarray, dt: float) -> list[tuple[int, int, int]]:
        """Return the first tick, fit tick and end tick of each window that contains enough flight data.

        Raises:
            LogError: There is no such window.
        """
        buffer, horizon, every = (max(1, round(x / dt)) for x in (self.buffer, self.horizon, self.every))
        result = []
        for now in range(buffer, len(valid) - horizon + 1, every):
            before, after = valid[now - buffer : now], valid[now : now + horizon]
            if before.mean() >= LEAST_VALID and after.mean() >= LEAST_VALID:
                result.append((now - buffer, now, now + horizon))
        if not result:
            raise LogError(
                f"the log has {np.sum(valid) * dt:.1f} s of flight, and no {self.buffer + self.horizon:g} s of it in "
                f"one piece; choose a shorter --buffer or --horizon"
            )
        return result


def predict_log(
    rows: Targets, dt: float, predictors: Mapping[str, Callable[[], Predictor]], protocol: Protocol
) -> Iterator[PredictionScore]:
    """Fit and predict window by window, for each predictor in turn.

    Args:
        rows: Rows of the whole log.
        dt: Tick [s].
        predictors: Factory of each predictor, by name.
        protocol: Buffer, horizon and time between fits.

    Raises:
        LogError: The log is too short.
    """
    windows = protocol.windows(np.asarray(rows.valid), dt)
    parts = [(_part(rows, first, now), _part(rows, now, last)) for first, now, last in windows]
    for name, begin in predictors.items():
        predictor, squares = begin(), []
        for buffer, ahead in parts:
            valid = np.asarray(ahead.valid)
            errors = (np.asarray(ahead.a_res) - predictor(buffer)(ahead))[valid]
            squares.append(np.mean(errors**2, axis=0))
        mean = np.mean(squares, axis=0)
        x, y, z = np.sqrt(mean)
        per_window = tuple(float(np.sqrt(square.sum())) for square in squares)
        times = tuple(round(now * dt, 6) for _, now, _ in windows)
        yield PredictionScore(name, float(np.sqrt(mean.sum())), (float(x), float(y), float(z)), per_window, times)


def _part(rows: Targets, first: int, last: int) -> Targets:
    result: Targets = jax.tree.map(lambda leaf: leaf[first:last], rows)
    return result
