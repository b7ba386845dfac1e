"""Defines a log's columns with their recorded times, and the interface for readers."""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Protocol, TypeVar, runtime_checkable

import numpy as np

from ...config.validation import suggestion
from ...errors import LogError

T = TypeVar("T")
MOST_NAMES = 30  # maximum number of names in an error message


@dataclass(frozen=True)
class Series:
    """The samples of one quantity."""

    t: np.ndarray
    """Times [s], (n,)."""
    values: np.ndarray
    """Values, (n, columns)."""


@runtime_checkable
class LogReader(Protocol):
    """Reads one log file format."""

    def __call__(
        self,
        path: Path,
        request: Mapping[str, Sequence[str]],
        time: "Clock | None",
        optional: Collection[str] = (),
    ) -> tuple[dict[str, Series], list[str]]:
        """Read the requested quantities.

        Args:
            path: The file, or a bag's folder.
            request: Field names for each quantity, in the format's notation. A field may contain several numbers. A
                minus sign may precede a name, and alternatives may follow the name; see :func:`first_of`.
            time: Time field; None for the format's own times.
            optional: Quantities that are left out if the log does not contain them.

        Returns:
            Each quantity's series, and notes on excluded data.

        Raises:
            LogError: The file cannot be read, or a field is missing.
        """
        ...


@dataclass(frozen=True)
class Clock:
    """The time field."""

    field: str
    scale: float
    """Length of one unit [s]."""


def first_of(name: str, look: Callable[[str], T]) -> T:
    """Return the result of ``look`` for the first existing alternative in a field such as ``a|b``.

    Raises:
        LogError: No alternative exists; the message refers to the first.
    """
    errors = list[LogError]()
    for each in name.removeprefix("-").split("|"):
        try:
            return look(each)
        except LogError as error:
            errors.append(error)
    raise errors[0]


def find_fields(
    request: Mapping[str, Sequence[str]], look: Callable[[str], T], optional: Collection[str]
) -> Iterator[tuple[str, list[T]]]:
    """Yield each quantity with the results of ``look`` for its fields; omit optional quantities with a missing field.

    Raises:
        LogError: A field of another quantity is missing.
    """
    for what, names in request.items():
        try:
            fields = [first_of(name, look) for name in names]
        except LogError:
            if what not in optional:
                raise
        else:
            yield what, fields


def sign_of(name: str) -> float:
    """Return minus one for a field with a leading minus sign, and one otherwise."""
    return -1.0 if name.startswith("-") else 1.0


def missing_field(path: Path, name: str, names: Sequence[str]) -> LogError:
    """Return the error for a missing field."""
    more = f", and {len(names) - MOST_NAMES} more" if len(names) > MOST_NAMES else ""
    near = get_close_matches(name, names, n=1)
    shown_names = [
        "".join(c if c.isprintable() else "\ufffd" for c in each[:80]) for each in dict.fromkeys([*near, *names])
    ][:MOST_NAMES]
    known = suggestion(name, shown_names) if shown_names else "the log has none"
    return LogError(f"{path}: no field {name[:80]!r}; {known}{more}")
