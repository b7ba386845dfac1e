"""Stalls of the machine: times in which not even the process that comes before all others ran.

The watchdog does next to nothing, every two milliseconds, with the highest priority. Where it was kept from that for
longer, so was everyone on its core: by the kernel, or by the host of a virtual machine. A tick that was missed
meanwhile is not one that control or plant were too slow for.
"""

from collections import deque
from collections.abc import Sequence
from typing import Any

from .messages import pack_note

STALL = 0.003  # [s]
KEPT = 100  # newest ones


class Stalls:
    """Those that were seen."""

    def __init__(self, every: float) -> None:
        """Begin with none.

        Args:
            every: Time between wake-ups [s].
        """
        self.count, self.longest = 0, 0.0
        self.newest: deque[tuple[float, float]] = deque(maxlen=KEPT)
        """From when to when [s]."""
        self._every = every
        self._woke: float | None = None

    def woke(self, now: float) -> bool:
        """Take note of a wake-up; return whether the machine stood still before it.

        Args:
            now: Monotonic clock [s].
        """
        before, self._woke = self._woke, now
        if before is None or now - before <= self._every + STALL:
            return False
        self.count, self.longest = self.count + 1, max(self.longest, now - before - self._every)
        self.newest.append((before, now))
        return True

    def pack(self) -> bytes:
        """Return them as a note."""
        newest = [list(each) for each in self.newest]
        return pack_note("stalls", count=self.count, longest=self.longest, newest=newest)


def lost_in(stalls: Sequence[Sequence[Any]], gaps: Sequence[Sequence[Any]], dt: float) -> int:
    """Return how many ticks were missed while the machine stood still, or while a plant caught up within a tick after.

    Args:
        stalls: From when to when it did [s].
        gaps: From the measurement before missed ticks to the one after them [s], and how many these were.
        dt: Control tick [s].
    """
    return sum(int(n) for a, b, n in gaps if any(begin < b and end + dt > a for begin, end in stalls))
