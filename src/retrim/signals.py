"""Signals that end a command and keep what is done: Ctrl-C, SIGTERM, and SIGHUP of a terminal that was closed."""

import contextlib
import os
import signal
import stat
import sys
import threading
from collections.abc import Callable, Iterator
from types import FrameType

Handler = Callable[[int, FrameType | None], None]


def ending_signals() -> list[signal.Signals]:
    """Return the signals that end a command; SIGHUP is none where ``nohup`` has it ignored."""
    found = [signal.SIGINT, signal.SIGTERM]
    if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
        found.append(signal.SIGHUP)
    return found


@contextlib.contextmanager
def handled_by(handler: Handler) -> Iterator[None]:
    """Let a function answer the signals that end a command; in any thread but the main one this does nothing."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def handle(number: int, frame: FrameType | None) -> None:
        leave_lost_terminal()
        handler(number, frame)

    before = {number: signal.signal(number, handle) for number in ending_signals()}
    try:
        yield
    finally:
        for number, earlier in before.items():
            signal.signal(number, earlier)


@contextlib.contextmanager
def stopped_by(stop: threading.Event) -> Iterator[None]:
    """Let the signals set ``stop`` and raise: a KeyboardInterrupt that JAX swallows is not lost."""

    def handle(number: int, frame: FrameType | None) -> None:
        stop.set()
        raise KeyboardInterrupt

    def swallowed(error: "sys.UnraisableHookArgs") -> None:
        if not isinstance(error.exc_value, KeyboardInterrupt):
            sys.__unraisablehook__(error)

    hook, sys.unraisablehook = sys.unraisablehook, swallowed
    try:
        with handled_by(handle):
            yield
    finally:
        sys.unraisablehook = hook


def leave_lost_terminal() -> None:
    """Let standard outputs go nowhere that led to a terminal that is gone; what is written there is an error."""
    for descriptor in (1, 2):
        with contextlib.suppress(OSError):
            if stat.S_ISCHR(os.fstat(descriptor).st_mode) and not os.isatty(descriptor):
                nowhere = os.open(os.devnull, os.O_WRONLY)
                os.dup2(nowhere, descriptor)
                os.close(nowhere)
