"""Defines the interface for progress reports on long tasks; the library itself never prints."""

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import Protocol, runtime_checkable

Advance = Callable[[float, str], None]
"""Receives the completed share (0 to 1) and a short text."""


@runtime_checkable
class Reporter(Protocol):
    """Receives lines of text and progress."""

    def say(self, text: str) -> None:
        """Receive one line of plain text."""
        ...

    def progress(self, title: str) -> AbstractContextManager[Advance]:
        """Return a context manager whose value receives the progress of one task."""
        ...


class Silent:
    """A reporter without output."""

    def say(self, text: str) -> None:
        """Ignore the line."""

    def progress(self, title: str) -> AbstractContextManager[Advance]:
        """Ignore the progress."""
        return nullcontext(_ignore)


def _ignore(share: float, text: str) -> None:
    """Ignore the advance."""
