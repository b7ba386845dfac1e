"""Heartbeats: each process of a flight says many times in a second that its main loop goes on.

Plant and control need none beside what they publish each tick. A loop that computes for seconds has a thread that beats
for it, for as long as the loop said beforehand: a loop that hangs is silent, even where its threads go on.
"""

import contextlib
import threading
import time
from collections.abc import Callable

from ..errors import MessageError
from ..transport.bus import Bus
from .messages import pack_note

EVERY = 0.1  # [s] between two beats


def beat_topic(role: str) -> str:
    """Return the topic that says that a process goes on."""
    return {"plant": "sample", "control": "setpoint"}.get(role, f"beat.{role}")


class Heart:
    """Beats when a main loop comes by."""

    def __init__(self, bus: Bus, role: str, clock: Callable[[], float] = time.monotonic) -> None:
        """Build it for a process.

        Args:
            bus: Of the flight; without a topic for the beats of the role nothing is said.
            role: Of the process.
            clock: The time [s].
        """
        self._bus, self._topic, self._clock = bus, beat_topic(role), clock
        self._count, self._next = 0, float("-inf")

    def beat(self) -> None:
        """Say that the loop goes on, unless that was said a moment ago."""
        now = self._clock()
        if now < self._next:
            return
        self._count, self._next = self._count + 1, now + EVERY
        with contextlib.suppress(MessageError):
            self._bus.publish(self._topic, pack_note(self._topic, count=self._count))


class Pacemaker:
    """Beats in a thread of its own while a main loop is within the time that it gave itself."""

    def __init__(self, bus: Bus, role: str, clock: Callable[[], float] = time.monotonic) -> None:
        """Build it for a process; the thread runs while this is a context."""
        self._heart, self._clock = Heart(bus, role, clock), clock
        self._until, self._over = float("-inf"), threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> "Pacemaker":
        """Begin to beat."""
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        """End the thread."""
        self._over.set()
        self._thread.join()

    def touch(self, allowance: float) -> None:
        """Take note that the main loop goes on, and comes by again within ``allowance`` [s]."""
        self._until = self._clock() + allowance

    def beat(self) -> None:
        """Beat if the main loop is not late."""
        if self._clock() <= self._until:
            self._heart.beat()

    def _run(self) -> None:
        while not self._over.wait(EVERY):
            self.beat()
