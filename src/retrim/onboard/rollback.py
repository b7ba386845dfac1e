"""Whether a policy flies clearly worse than the one before it, in a world that has not changed."""

from collections import deque
from dataclasses import dataclass, field

import numpy as np


@dataclass
class FlownError:
    """Watches the distance from the target before and after a swap."""

    dt: float
    factor: float = 3.0
    """A policy is clearly worse if its error is so many times that before the swap, ..."""
    least: float = 0.1
    """... and larger than this [m] ..."""
    settle_s: float = 0.5
    """... in the half second that ends so long or longer after the swap, ..."""
    watch_s: float = 2.0
    """... and no longer than this."""
    surprise: float = 1.0
    """If the corrected model misses so much more than before the swap [m/s^2], the world is to blame."""
    _seen: deque[tuple[float, float]] = field(default_factory=deque)
    _before: tuple[float, float] | None = None
    _since: int = 0

    def swapped(self) -> None:
        """A new policy flies from now on."""
        self._before, self._since = (self._means() if self._seen else None), 0

    def worse(self, error: float, missed: float) -> bool:
        """Take what one tick says; return whether the policy is to be taken back.

        Args:
            error: Distance from the target [m].
            missed: By how much the corrected model misses the acceleration [m/s^2].
        """
        self._seen.append((error, missed))
        while len(self._seen) > max(1, round(0.5 / self.dt)):
            self._seen.popleft()
        if self._before is None:
            return False
        self._since += 1
        t, (error, missed), (error_before, missed_before) = self._since * self.dt, self._means(), self._before
        if t > self.watch_s or missed > missed_before + self.surprise:
            self._before = None
            return False
        if t < self.settle_s or not error > max(self.factor * error_before, self.least):
            return False
        self._before = None
        return True

    def _means(self) -> tuple[float, float]:
        error, missed = np.mean(self._seen, axis=0)
        return float(error), float(missed)
