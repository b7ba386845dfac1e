"""Defines the interface for progress reports on long tasks; the library itself never prints."""

from contextlib import AbstractContextManager
from typing import Protocol, runtime_checkable

from ..progress import Advance as Advance
from ..progress import no_progress


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
        return no_progress(title)
