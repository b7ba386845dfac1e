"""Columns of a log with their times, as they were recorded."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np

from ...config.validation import suggestion
from ...errors import LogError


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
