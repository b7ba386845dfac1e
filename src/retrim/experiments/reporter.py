"""How long work tells what it does; the library itself never prints."""

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import Protocol, runtime_checkable

Advance = Callable[[float, str], None]
"""From the share that is done (0 to 1) and a short text to nothing."""


@runtime_checkable
class Reporter(Protocol):
    """Receives lines and progress."""

    def say(self, text: str) -> None:
        """Receive one line of plain text."""
        ...

    def progress(self, title: str) -> AbstractContextManager[Advance]:
        """Return a context in which the advance of one piece of work is received."""
        ...


class Silent:
    """Says nothing."""

    def say(self, text: str) -> None:
        """Ignore it."""

    def progress(self, title: str) -> AbstractContextManager[Advance]:
        """Ignore all of it."""
        return nullcontext(_ignore)


def _ignore(share: float, text: str) -> None:
    """Ignore the advance."""
