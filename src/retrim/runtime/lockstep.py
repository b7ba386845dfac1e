"""Learning on a virtual clock: what a live run does, but repeatable bit for bit.

Compute time is charged to flight time. A window that is submitted at a tick is learnt from at once; the result becomes
visible only after the latency of the computation, as if the learner had worked beside the flight.
"""

import math
import time

from ..adapt.updates import Skip, Update
from ..adapt.workers import Worker
from ..learn.window import Window
from .learner import Learner


class LockstepLearner(Learner):
    """One worker on the virtual clock: at most one window under way, whose update appears later."""

    def __init__(self, worker: Worker, latency_s: float | None, dt: float) -> None:
        """Build a learner.

        Args:
            worker: What learns.
            latency_s: Flight time from a window to its update [s]; None: as long as the worker takes by the clock.
            dt: Control tick [s]; latencies are rounded up to whole ticks.
        """
        self.worker, self.latency_s, self._dt = worker, latency_s, dt
        self._ready: tuple[int, Update] | None = None
        self._skipped: list[Update] = []

    def submit(self, window: Window, tick: int) -> None:
        """Learn from ``window`` now; note a skip if the last update is not visible yet."""
        if self._ready is not None:
            self._skipped.append(Skip(float(window.t[-1]), self.worker.layer))
            return
        began = time.perf_counter()
        update = self.worker.learn(window)
        seconds = time.perf_counter() - began if self.latency_s is None else self.latency_s
        self._ready = (tick + self.ticks(seconds), update)

    def ticks(self, seconds: float) -> int:
        """Return after how many ticks the update of a computation that takes ``seconds`` is visible: at least one."""
        return max(1, math.ceil(seconds / self._dt - 1e-6))

    def poll(self, tick: int) -> list[Update]:
        """Return the updates that are visible at this tick."""
        found, self._skipped = self._skipped, []
        if self._ready is not None and self._ready[0] <= tick:
            found, self._ready = [*found, self._ready[1]], None
        return found

    def receive(self, update: Update) -> None:
        """Pass a published update on to the worker."""
        self.worker.receive(update)

    def reset(self) -> None:
        """Drop what is under way."""
        self._ready, self._skipped = None, []
