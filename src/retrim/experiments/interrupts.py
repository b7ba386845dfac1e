"""Ctrl-C, SIGTERM and a closed terminal at moments when they must not raise."""

import contextlib
import threading
from collections.abc import Iterator

from ..signals import handled_by


@contextlib.contextmanager
def interrupts_only_set(stop: threading.Event) -> Iterator[None]:
    """Let the signals that end a command set ``stop`` and nothing else, so that what is done is written whole.

    Only the main thread receives signals; in any other this does nothing.
    """
    with handled_by(lambda *_: stop.set()):
        yield
