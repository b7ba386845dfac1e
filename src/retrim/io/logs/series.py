"""Columns of a log with their times, as they were recorded."""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Protocol, TypeVar, runtime_checkable

import numpy as np

from ...config.validation import suggestion
from ...errors import LogError

T = TypeVar("T")
MANY = 30  # names that a message lists


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
        self,
        path: Path,
        wanted: Mapping[str, Sequence[str]],
        time: "Clock | None",
        optional: Collection[str] = (),
    ) -> tuple[dict[str, Series], list[str]]:
        """Read the quantities that are wanted.

        Args:
            path: The file, or the folder of a bag.
            wanted: Field names of each quantity, as the format names them; a field may hold several numbers. Before it
                there may be a minus sign, and behind it alternatives; see :func:`first_of`.
            time: Where times are; None for those of the format.
            optional: Quantities that are left out if the log does not have them.

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


def first_of(name: str, look: Callable[[str], T]) -> T:
    """Return what ``look`` finds for the first of the alternatives of a field, ``a|b``, that is there.

    Raises:
        LogError: None of them is; the message is that of the first.
    """
    errors = list[LogError]()
    for each in name.removeprefix("-").split("|"):
        try:
            return look(each)
        except LogError as error:
            errors.append(error)
    raise errors[0]


def sign_of(name: str) -> float:
    """Return minus one for a field with a minus sign before it, otherwise one."""
    return -1.0 if name.startswith("-") else 1.0


def missing_field(path: Path, name: str, known: Sequence[str]) -> LogError:
    """Return the error for a field that is not there."""
    more = f", and {len(known) - MANY} more" if len(known) > MANY else ""
    near = get_close_matches(name, known, n=1)
    shown = ["".join(c if c.isprintable() else "\ufffd" for c in each[:80]) for each in dict.fromkeys([*near, *known])][
        :MANY
    ]
    return LogError(f"{path}: no field {name[:80]!r}; {suggestion(name, shown)}{more}")
