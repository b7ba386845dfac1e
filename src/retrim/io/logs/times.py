"""Checks sample times: drops impossible, late and repeated ones, and reports several flights in one file."""

import math
from bisect import bisect_right
from collections.abc import Callable
from pathlib import Path

import numpy as np

from ...errors import LogError
from .series import Series

LATE_S = 0.5  # time by which a sample may be older than the previous one [s]; a larger step indicates another flight
LARGEST = 1e15  # in any unit; larger values are damaged
MOST_IMPOSSIBLE = 0.05  # largest share of samples with an impossible time
LEAST_GAP_S = 60.0  # [s], least distance of such a time from all others
LEAST_GAP = 3.0  # the same in lengths of the log
LEAST_SAMPLES = 50  # minimum number of samples among which a time may be impossible


def in_order(series: Series, what: str, path: Path) -> tuple[Series, list[str]]:
    """Return a series with increasing times and finite values, and notes on excluded samples.

    Messages are logged when they arrive. A state is logged again until a newer one arrives, and errors in reading the
    clock can give the copy an older time. One thread may overtake another, and a stamp may never be set. Samples with
    such faults are left out.

    Raises:
        LogError: Times decrease or are constant, or no sample remains.
    """
    notes, count = list[str](), len(series.t)
    finite = np.isfinite(series.t) & np.all(np.abs(series.values) < LARGEST, axis=1)
    if not finite.any():
        raise LogError(f"{path}: {what} has no finite sample among {count}")
    rules: tuple[tuple[Callable[[np.ndarray], np.ndarray], str], ...] = (
        (lambda _: ~finite, "are not finite"),
        (impossible, "have an impossible time"),
        (late, "are not newer than the one before"),
        (find_repeats, "have the time of the one before"),
    )
    for rule, words in rules:
        out = rule(series.t)
        if dropouts := int(np.sum(out)):
            notes.append(f"{what}: {dropouts} of {count} samples {words}, and are left out")
            series = Series(series.t[~out], series.values[~out])
    t = series.t
    if (back := np.flatnonzero(np.diff(t) < 0)).size:
        k = int(back[0])
        raise LogError(
            f"{path}: the time of {what} goes back {back.size} times, first by {t[k] - t[k + 1]:.3f} s, "
            f"{t[k] - t[0]:.3f} s after the beginning (sample {k + 1}); are these several flights in one file?"
        )
    if len(t) < 2:
        raise LogError(f"{path}: {what} has {count} samples, all at one time; a flight needs times that rise")
    return series, notes


def impossible(t: np.ndarray) -> np.ndarray:
    """Return a mask of times that are far from their neighbours, for example a zero stamp in the middle.

    If too many times are far away, none of them is marked.
    """
    none, most = np.zeros(len(t), dtype=bool), math.ceil(MOST_IMPOSSIBLE * len(t))
    if len(t) < LEAST_SAMPLES:
        return none
    first, last = np.quantile(t, [MOST_IMPOSSIBLE, 1.0 - MOST_IMPOSSIBLE])
    reach = max(LEAST_GAP_S, LEAST_GAP * (last - first))
    earliest = np.min(t, where=t > 0.0, initial=np.inf)
    out = (t < first - reach) | (t > last + reach) | ((t == 0.0) & (earliest > LATE_S))
    inside = t[~out]
    if np.any(np.diff(inside) < -LATE_S):
        rising = _longest_rise(inside)
        newest = np.fmax.accumulate(np.where(rising, inside, -np.inf))
        out[~out] = ~rising & (np.abs(inside - newest) > LATE_S)
    return out if np.sum(out) <= most else none


def late(t: np.ndarray) -> np.ndarray:
    """Return a mask of times that are older than an earlier sample's, but not old enough for another flight."""
    newest = np.concatenate([[-np.inf], np.fmax.accumulate(t)[:-1]])
    return np.asarray((t < newest) & (t > newest - LATE_S))


def find_repeats(t: np.ndarray) -> np.ndarray:
    """Return a mask of times that equal the previous one."""
    return np.concatenate([[False], np.diff(t) == 0.0])


def _longest_rise(t: np.ndarray) -> np.ndarray:
    """Return a mask of the longest non-decreasing subsequence of times."""
    ends, places, before = list[float](), list[int](), np.full(len(t), -1)
    for k, x in enumerate(t.tolist()):
        at = bisect_right(ends, x)
        before[k] = places[at - 1] if at else -1
        ends[at : at + 1], places[at : at + 1] = [x], [k]
    rising, k = np.zeros(len(t), dtype=bool), places[-1]
    while k >= 0:
        rising[k], k = True, int(before[k])
    return rising
