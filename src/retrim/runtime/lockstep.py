"""Learn on a virtual clock; the result is equivalent to a live run but repeatable bit for bit.

Compute time is charged to flight time. The learner processes a window at the tick of its submission; the result becomes
visible only after the latency of the computation, as if the learner had run in parallel with the flight.
"""

import math
import time

from ..adapt.updates import Skip, Update
from ..adapt.worker import Worker
from ..learn.window import Window
from .learner import Learner


class LockstepLearner(Learner):
    """One worker on the virtual clock; at most one window is in progress, and its update becomes visible later."""

    def __init__(self, worker: Worker, latency_s: float | None, dt: float) -> None:
        """Build a learner.

        Args:
            worker: Worker that learns from the windows.
            latency_s: Flight time from a window to its update [s]; None for the worker's measured compute time.
            dt: Control tick [s]; latencies are rounded up to whole ticks.
        """
        self.worker, self.latency_s, self._dt = worker, latency_s, dt
        self._ready: tuple[int, Update] | None = None
        self._skips: list[Update] = []

    @property
    def batchable(self) -> tuple[Worker, int] | None:
        """The worker if its class forms batches, and its latency [ticks] if it does not depend on the compute time."""
        if self.latency_s is None or self.worker.batch is None:
            return None
        return self.worker, self.ticks(self.latency_s)

    def submit(self, window: Window, tick: int) -> None:
        """Learn from ``window`` now; record a skip if the last update is not visible yet."""
        if self._ready is not None:
            self._skips.append(Skip(float(window.t[-1]), self.worker.layer))
            return
        began = time.perf_counter()
        update = self.worker.learn(window)
        seconds = time.perf_counter() - began if self.latency_s is None else self.latency_s
        self._ready = (tick + self.ticks(seconds), update)

    def ticks(self, seconds: float) -> int:
        """Return the number of ticks, at least one, until the result of a computation of ``seconds`` is visible."""
        return max(1, math.ceil(seconds / self._dt - 1e-6))

    def poll(self, tick: int) -> list[Update]:
        """Return the updates that are visible at this tick."""
        result, self._skips = self._skips, []
        if self._ready is not None and self._ready[0] <= tick:
            result, self._ready = [*result, self._ready[1]], None
        return result

    def receive(self, update: Update) -> None:
        """Pass a published update on to the worker."""
        self.worker.receive(update)

    def reset(self) -> None:
        """Drop the pending update."""
        self._ready, self._skips = None, []
