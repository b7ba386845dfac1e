"""Columns of a log with their times, as they were recorded."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np

from ...config.validation import suggestion
from ...errors import LogError

LATE_S = 0.5  # [s] by which a state may be older than the one before; more is of another flight


@dataclass(frozen=True)
class Series:
    """Samples of one quantity."""

    t: np.ndarray
    """Times [s], (n,)."""
    values: np.ndarray
    """(n, columns)."""


@runtime_checkable
class LogReader(Protocol):
    """Reads one format of log files."""

    def __call__(
        self, path: Path, wanted: Mapping[str, Sequence[str]], time: "Clock | None"
    ) -> tuple[dict[str, Series], list[str]]:
        """Read the quantities that are wanted.

        Args:
            path: The file, or the folder of a bag.
            wanted: Field names of each quantity, as the format names them; a field may hold several numbers.
            time: Where times are, in formats that have no time of their own.

        Returns:
            Each quantity, and notes on what was left out.

        Raises:
            LogError: The file cannot be read, or a field is not there.
        """
        ...


@dataclass(frozen=True)
class Clock:
    """The field of times."""

    field: str
    scale: float
    """[s] of one unit."""


def missing_field(path: Path, name: str, known: Sequence[str]) -> LogError:
    """Return the error for a field that is not there."""
    return LogError(f"{path}: no field {name!r}; {suggestion(name, known)}")


def newer(series: Series, what: str) -> tuple[Series, list[str]]:
    """Return the samples of a state that are newer than all before, and a note on those that were left out.

    States are logged when they come. One is logged again while nothing newer comes, and a clock that is read with an
    error makes it older then; another overtakes one before it. What goes back further is kept: :func:`in_order` refuses
    it.
    """
    newest = np.concatenate([[-np.inf], np.fmax.accumulate(series.t)[:-1]])
    late = (series.t <= newest) & (series.t > newest - LATE_S)
    if not late.any():
        return series, []
    note = f"{what}: {np.sum(late)} of {len(late)} samples are not newer than the one before, and are left out"
    return Series(series.t[~late], series.values[~late]), [note]


def in_order(series: Series, what: str, path: Path) -> tuple[Series, list[str]]:
    """Return a series whose times rise and whose values are finite, and notes on what was left out.

    Raises:
        LogError: Times go back or stand still, or nothing is left.
    """
    t, values, notes = series.t, series.values, list[str]()
    finite = np.isfinite(t) & np.all(np.isfinite(values), axis=1)
    if not finite.any():
        raise LogError(f"{path}: {what} has no finite sample among {len(t)}")
    if lost := int(np.sum(~finite)):
        notes.append(f"{what}: {lost} of {len(t)} samples are not finite, and are left out")
        t, values = t[finite], values[finite]
    if len(t) < 2 or t.max() == t.min():
        raise LogError(f"{path}: {what} has {len(t)} samples, all at one time; a flight needs times that rise")
    step = np.diff(t)
    if (back := np.flatnonzero(step < 0)).size:
        k = int(back[0])
        raise LogError(
            f"{path}: the time of {what} goes back {back.size} times, first from {t[k]:.6g} to {t[k + 1]:.6g} s "
            f"(sample {k + 1}); are these several flights in one file?"
        )
    if (same := int(np.sum(step == 0))) > 0:
        notes.append(f"{what}: {same} of {len(t)} samples have the time of the one before, and are left out")
        first = np.concatenate([[True], step > 0])
        t, values = t[first], values[first]
    return replace(series, t=t, values=values), notes
