"""Reads an autopilot's marks in its log: the validity of estimates, estimator resets, and landing."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from .log_map import LandDetector, LogMap
from .series import Series

QUANTITIES = ("position", "velocity", "attitude")


@dataclass(frozen=True)
class Marks:
    """An autopilot's marks at the ticks of a grid."""

    holds: Mapping[str, np.ndarray]
    """Ticks at which a quantity is valid, (n,); quantities without flags are absent."""
    resets: Mapping[str, np.ndarray]
    """Ticks at which a quantity was reset since the previous tick, (n,)."""
    on_ground: np.ndarray
    """Ticks at which the vehicle is on the ground, (n,); all false if the log has no such field."""


def marks_of(log_map: LogMap, series: Mapping[str, Series], t: np.ndarray) -> Marks:
    """Return a log's marks at the times of a grid."""
    holds, resets = dict[str, np.ndarray](), dict[str, np.ndarray]()
    for name in QUANTITIES:
        spec = getattr(log_map, name)
        for k, field in enumerate(getattr(spec, "valid", ())):
            if (flag := series.get(f"{name} valid {k}")) is not None:
                before, after = _around(flag, t)
                good = _true(before, field) & _true(after, field)
                holds[name] = holds.get(name, np.ones(len(t), dtype=bool)) & good
        for k in range(len(getattr(spec, "resets", ()))):
            if (counter := series.get(f"{name} resets {k}")) is not None:
                count = _around(counter, t)[0]
                changes = np.concatenate([[False], np.diff(count) != 0.0])
                resets[name] = resets.get(name, np.zeros(len(t), dtype=bool)) | changes
    return Marks(holds, resets, landed_at(log_map.landed, series, t))


def landed_at(detector: LandDetector | None, series: Mapping[str, Series], t: np.ndarray) -> np.ndarray:
    """Return the times of a grid at which a land detector reports the ground; none without a detector."""
    on_ground = np.zeros(len(t), dtype=bool)
    for k, field in enumerate(() if detector is None else detector.fields):
        if (flag := series.get(f"landed {k}")) is not None:
            on_ground |= _true(_around(flag, t)[0], field)
    return on_ground


def _around(series: Series, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the sample values at or before each time, and those at or after it."""
    last = len(series.t) - 1
    before = np.clip(np.searchsorted(series.t, t, side="right") - 1, 0, last)
    after = np.clip(np.searchsorted(series.t, t, side="left"), 0, last)
    return series.values[before, 0], series.values[after, 0]


def _true(values: np.ndarray, field: str) -> np.ndarray:
    """Return where a flag is set: it is non-zero, or equals the number in its field, for example ``state==1``."""
    number = field.partition("==")[2]
    return np.asarray(values == float(number) if number else values != 0.0)
