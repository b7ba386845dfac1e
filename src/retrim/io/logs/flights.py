"""Chooses one of several flights in one log file."""

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple, Protocol

from ...errors import LogError
from .series import Clock, Series

SHORTEST = 1.0  # [s]: shorter flights are not offered if there are longer ones
MOST_FLIGHTS = 20  # largest number of flights in an error message


class FlightReader(Protocol):
    """A :class:`~retrim.io.logs.series.LogReader` that also takes the number of a flight."""

    def __call__(
        self,
        path: Path,
        request: Mapping[str, Sequence[str]],
        time: Clock | None,
        optional: Collection[str] = (),
        flight: int | None = None,
    ) -> tuple[dict[str, Series], list[str]]:
        """Read the requested quantities of one flight, which is numbered from 1."""
        ...


class Span(NamedTuple):
    """A flight in a file."""

    first: float
    """Time of the first sample [s]."""
    last: float

    @property
    def seconds(self) -> float:
        """Duration [s]."""
        return self.last - self.first


def choose_flight(path: Path, spans: Sequence[Span], number: int | None) -> tuple[int, list[str]]:
    """Return the index of the flight to read, and notes.

    Args:
        path: The file, for messages.
        spans: All flights in the file.
        number: Number of the requested flight, from 1; None if there is no choice to make.

    Raises:
        LogError: There are several flights and no number, or no flight has this number.
    """
    whole = [k for k, span in enumerate(spans) if span.seconds >= SHORTEST]
    description = ", ".join(f"{k + 1} of {span.seconds:.1f} s" for k, span in list(enumerate(spans))[:MOST_FLIGHTS])
    if len(spans) > MOST_FLIGHTS:
        description += f", and {len(spans) - MOST_FLIGHTS} more"
    if number is not None:
        if not 1 <= number <= len(spans):
            raise LogError(f"{path}: --flight {number}: the flights in this file are {description}")
        return number - 1, []
    if len(whole) > 1:
        raise LogError(
            f"{path}: {len(spans)} flights are in this file: {description}; choose one, as --flight {whole[0] + 1}"
        )
    k = whole[0] if whole else max(range(len(spans)), key=lambda k: spans[k].seconds)
    others = len(spans) - 1
    return k, [f"{others} other flights in this file last less than {SHORTEST:g} s"] if others else []
