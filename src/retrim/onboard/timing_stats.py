"""Statistics of lateness and durations, and rows of ticks without a measurement."""

from typing import Any

import numpy as np

from .guard import Mode
from .messages import ACCOUNTS, Sample, Stamp

EDGES_MS = (0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0)


def summary(seconds: np.ndarray) -> dict[str, Any]:
    """Return the p50, p99 and maximum [ms], and the histogram with the edges ``EDGES_MS`` and two open outer bins.

    Args:
        seconds: Durations [s].
    """
    if not len(seconds):
        return {"p50": None, "p99": None, "max": None, "histogram": [0] * (len(EDGES_MS) + 1)}
    ms = 1e3 * np.asarray(seconds)
    counts, _ = np.histogram(ms, bins=[-np.inf, *EDGES_MS, np.inf])
    p50, p99 = np.percentile(ms, [50, 99])
    return {"p50": float(p50), "p99": float(p99), "max": float(ms.max()), "histogram": counts.tolist()}


def is_from_control(rows: np.ndarray) -> np.ndarray:
    """Return which ticks the control process reported; rows from the watchdog do not contain a step duration.

    Args:
        rows: Rows with the columns in :data:`retrim.onboard.messages.COLUMNS`.
    """
    result: np.ndarray = rows[:, ACCOUNTS["step"]] > 0.0
    return result


def blind_row(
    sample: Sample, stamp: Stamp, now: float, start: float, dt: float, u: np.ndarray, mode: Mode
) -> np.ndarray:
    """Return the row of a command without a new measurement, with the last known state and its age.

    Args:
        sample: Last measurement.
        stamp: Stamp of the last message from the plant; the state in that message may have been refused.
        now: Current time of the monotonic clock [s].
        start: Time of the first measurement on the plant's clock [s].
        dt: Control tick [s].
        u: Command [c, omega].
        mode: Active mode of the guard.
    """
    after = max(stamp.tick - sample.tick, int((now - sample.send_time) / dt), 1)
    age = sample.age + now - sample.send_time
    t = sample.t + after * dt - start
    head = [sample.tick + after, t, age]
    return np.concatenate([head, sample.state, sample.truth, u, [0.0, 0.0, 0.0, age, 0.0, t, mode]])


def has_measurement(rows: np.ndarray) -> np.ndarray:
    """Return which rows contain a new measurement; the other rows contain an old state.

    Args:
        rows: Rows with the columns in :data:`retrim.onboard.messages.COLUMNS`.
    """
    result: np.ndarray = is_from_control(rows) | ~np.isin(rows[:, -1], (Mode.BLIND, Mode.DROP))
    return result
