"""Detect stalls of the machine: intervals in which even the process with the highest priority did not run.

The watchdog wakes up every two milliseconds with the highest priority and does very little work. If its wake-up is
late, the kernel or the host of a virtual machine has delayed every process on its core. A slow control or plant process
is not the cause of ticks missed in such an interval.
"""

from collections import deque
from collections.abc import Sequence
from typing import Any

from .messages import pack_note

STALL = 0.003  # [s]
MEMORY = 100  # number of stalls that are kept, the newest ones


class Stalls:
    """Record of the detected stalls."""

    def __init__(self, every: float) -> None:
        """Begin without stalls.

        Args:
            every: Time between wake-ups [s].
        """
        self.count, self.longest = 0, 0.0
        self.newest: deque[tuple[float, float]] = deque(maxlen=MEMORY)
        """Start and end of each stall [s]."""
        self._every = every
        self._woke: float | None = None

    def woke(self, now: float) -> bool:
        """Record a wake-up; return whether the machine stalled before it.

        Args:
            now: Current time of the monotonic clock [s].
        """
        before, self._woke = self._woke, now
        if before is None or now - before <= self._every + STALL:
            return False
        self.count, self.longest = self.count + 1, max(self.longest, now - before - self._every)
        self.newest.append((before, now))
        return True

    def pack(self) -> bytes:
        """Return the stalls as the bytes of a note."""
        newest = [list(each) for each in self.newest]
        return pack_note("stalls", count=self.count, longest=self.longest, newest=newest)


def count_lost_ticks(stalls: Sequence[Sequence[Any]], gaps: Sequence[Sequence[Any]], dt: float) -> int:
    """Return the number of ticks missed during a stall or within one tick after the stall, while the plant caught up.

    Args:
        stalls: Start and end of each stall [s].
        gaps: Times of the measurements before and after missed ticks [s], and the number of missed ticks.
        dt: Control tick [s].
    """
    return sum(int(n) for a, b, n in gaps if any(begin < b and end + dt > a for begin, end in stalls))
