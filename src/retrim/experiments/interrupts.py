"""Ctrl-C at moments when it must not raise."""

import contextlib
import signal
import threading
from collections.abc import Iterator


@contextlib.contextmanager
def interrupts_only_set(stop: threading.Event) -> Iterator[None]:
    """Let Ctrl-C set ``stop`` and nothing else, so that what is done is written whole.

    Only the main thread receives a Ctrl-C; in any other this does nothing.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, lambda number, frame: stop.set())
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
