"""Handle the signals that end a command but keep its results: Ctrl-C, SIGTERM, and SIGHUP from a closed terminal."""

import contextlib
import os
import signal
import stat
import sys
import threading
from collections.abc import Callable, Iterator
from types import FrameType

from .standard_outputs import discard

Handler = Callable[[int, FrameType | None], None]


def ending_signals() -> list[signal.Signals]:
    """Return the signals that end a command; SIGHUP is excluded if ``nohup`` made the process ignore it."""
    result = [signal.SIGINT, signal.SIGTERM]
    if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
        result.append(signal.SIGHUP)
    return result


@contextlib.contextmanager
def handle_signals(handler: Handler) -> Iterator[None]:
    """Call a function on each signal that ends a command; only in the main thread."""
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
def stop_on_signal(stop: threading.Event) -> Iterator[None]:
    """Make ending signals set ``stop`` and raise KeyboardInterrupt; ``stop`` stays set if JAX swallows the error.

    Raises:
        KeyboardInterrupt: A signal arrived, or ``stop`` was already set.
    """

    def handle(number: int, frame: FrameType | None) -> None:
        stop.set()
        raise KeyboardInterrupt

    def report_signal(error: "sys.UnraisableHookArgs") -> None:
        if not isinstance(error.exc_value, KeyboardInterrupt):
            sys.__unraisablehook__(error)

    hook, sys.unraisablehook = sys.unraisablehook, report_signal
    try:
        with handle_signals(handle):
            if stop.is_set():
                raise KeyboardInterrupt
            yield
    finally:
        sys.unraisablehook = hook


def leave_lost_terminal() -> None:
    """Redirect the standard outputs of a closed terminal to the null device, since writes would raise errors."""
    for descriptor in (1, 2):
        with contextlib.suppress(OSError):
            if stat.S_ISCHR(os.fstat(descriptor).st_mode) and not os.isatty(descriptor):
                discard(descriptor)
