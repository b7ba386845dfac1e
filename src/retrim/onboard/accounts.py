"""Deadline accounts: how late each step began, how long it took, and what was missed."""

from typing import Any

import numpy as np

from .messages import ACCOUNTS

EDGES_MS = (0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0)


def summary(seconds: np.ndarray) -> dict[str, Any]:
    """Return p50, p99 and maximum [ms], and how many lie below each of ``EDGES_MS`` and above the last.

    Args:
        seconds: Durations [s].
    """
    if not len(seconds):
        return {"p50": None, "p99": None, "max": None, "histogram": [0] * (len(EDGES_MS) + 1)}
    ms = 1e3 * np.asarray(seconds)
    counts, _ = np.histogram(ms, bins=[-np.inf, *EDGES_MS, np.inf])
    p50, p99 = np.percentile(ms, [50, 99])
    return {"p50": float(p50), "p99": float(p99), "max": float(ms.max()), "histogram": counts.tolist()}


def accounted(rows: np.ndarray) -> np.ndarray:
    """Return which ticks the process that flies has reported: a step takes time, and the watchdog accounts for none.

    Args:
        rows: Columns as in :data:`retrim.onboard.messages.COLUMNS`.
    """
    found: np.ndarray = rows[:, ACCOUNTS["step"]] > 0.0
    return found
