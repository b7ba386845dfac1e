"""Whether new policies fly clearly worse than the last one that has proven itself, in a world that has not changed."""

from collections import deque
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np


class Judgement(NamedTuple):
    """What a tick has shown."""

    proven: int | None = None
    """Version that has flown long enough without harm."""
    worse: bool = False
    """All versions after the last proven one are to be taken back."""


class Watched(NamedTuple):
    """A policy that has not proven itself yet."""

    version: int
    since: int
    """Tick of its swap."""
    error: float
    """Mean error before it [m]."""
    missed: float
    """What the model missed before it [m/s^2]."""


@dataclass
class FlownError:
    """Watches the distance from the target before and after swaps, which may come faster than a verdict."""

    dt: float
    factor: float = 3.0
    """Policies are clearly worse if the error is so many times that before the first of them, ..."""
    least: float = 0.1
    """... and larger than this [m] ..."""
    settle_s: float = 0.5
    """... in the half second that ends so long or longer after its swap."""
    watch_s: float = 2.0
    """A policy that has flown so long has proven itself."""
    surprise: float = 1.0
    """If the corrected model misses so much more than before the swap [m/s^2], the world is to blame."""
    _seen: deque[tuple[float, float]] = field(default_factory=deque)
    _watched: deque[Watched] = field(default_factory=deque)
    _tick: int = 0

    def swapped(self, version: int) -> None:
        """A new policy flies from now on."""
        if self._seen:
            self._watched.append(Watched(version, self._tick, *self._means()))

    def take(self, error: float, missed: float) -> Judgement:
        """Take what one tick says.

        Args:
            error: Distance from the target [m].
            missed: By how much the corrected model misses the acceleration [m/s^2].
        """
        self._tick += 1
        self._seen.append((error, missed))
        while len(self._seen) > max(1, round(0.5 / self.dt)):
            self._seen.popleft()
        if not self._watched:
            return Judgement()
        error, missed = self._means()
        first = self._watched[0]
        flown_s = (self._tick - first.since) * self.dt
        if missed > first.missed + self.surprise:  # nobody can tell; what flies now is as good as any
            last = self._watched[-1].version
            self._watched.clear()
            return Judgement(proven=last)
        if flown_s >= self.settle_s and error > max(self.factor * first.error, self.least):
            self._watched.clear()
            return Judgement(worse=True)
        if flown_s > self.watch_s:
            return Judgement(proven=self._watched.popleft().version)
        return Judgement()

    def _means(self) -> tuple[float, float]:
        error, missed = np.mean(self._seen, axis=0)
        return float(error), float(missed)
