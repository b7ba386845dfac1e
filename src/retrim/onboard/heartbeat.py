"""Send heartbeats: each process of a flight reports many times per second that its main loop is running.

The messages that the plant and control publish each tick serve as their heartbeats. A loop that computes for several
seconds uses a thread to send its heartbeats, but only for the time that the loop announced beforehand. A loop that
hangs therefore becomes silent even if its threads continue.
"""

import contextlib
import threading
import time
from collections.abc import Callable

from ..errors import MessageError
from ..transport.bus import Bus
from .messages import pack_note

PERIOD = 0.1  # [s] between two heartbeats


def beat_topic(role: str) -> str:
    """Return the heartbeat topic of a process."""
    return {"plant": "sample", "control": "setpoint"}.get(role, f"beat.{role}")


class Heart:
    """Sends heartbeats when the main loop calls :meth:`beat`."""

    def __init__(self, bus: Bus, role: str, clock: Callable[[], float] = time.monotonic) -> None:
        """Build a heartbeat sender for a process.

        Args:
            bus: Bus of the flight; heartbeats are not published if the bus has no topic for those of the role.
            role: Role of the process.
            clock: Function that returns the time [s].
        """
        self._bus, self._topic, self._clock = bus, beat_topic(role), clock
        self._count, self._next = 0, float("-inf")

    def beat(self) -> None:
        """Publish a heartbeat unless the last one is recent."""
        now = self._clock()
        if now < self._next:
            return
        self._count, self._next = self._count + 1, now + PERIOD
        with contextlib.suppress(MessageError):
            self._bus.publish(self._topic, pack_note(self._topic, count=self._count))


class Pacemaker:
    """Sends heartbeats from its own thread until the time that the main loop has announced is over."""

    def __init__(self, bus: Bus, role: str, clock: Callable[[], float] = time.monotonic) -> None:
        """Build a pacemaker for a process; the thread runs while the context is open."""
        self._heart, self._clock = Heart(bus, role, clock), clock
        self._until, self._over = float("-inf"), threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> "Pacemaker":
        """Start the thread."""
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        """End the thread."""
        self._over.set()
        self._thread.join()

    def touch(self, allowance: float) -> None:
        """Record that the main loop is running and will call this method again within ``allowance`` [s]."""
        self._until = self._clock() + allowance

    def beat(self) -> None:
        """Send a heartbeat if the main loop is not late."""
        if self._clock() <= self._until:
            self._heart.beat()

    def _run(self) -> None:
        while not self._over.wait(PERIOD):
            self.beat()
