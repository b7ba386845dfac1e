"""Handles Ctrl-C, SIGTERM and a closed terminal while they must not raise."""

import contextlib
import threading
from collections.abc import Iterator

from ..signals import handle_signals


@contextlib.contextmanager
def interrupts_only_set(stop: threading.Event) -> Iterator[None]:
    """Let the signals that end a command only set ``stop``, so that output is written completely.

    Only the main thread receives signals; in other threads this has no effect.
    """
    with handle_signals(lambda *_: stop.set()):
        yield
