"""Detect new policies that fly clearly worse than the last proven policy in an unchanged world."""

from collections import deque
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np


class Judgement(NamedTuple):
    """Judgement of the unproven policies after one tick."""

    confirmed_version: int | None = None
    """Version that is now proven; None if there is none."""
    worse: bool = False
    """Whether all versions after the last proven one must be rolled back."""


class Trial(NamedTuple):
    """A policy that is not yet proven."""

    version: int
    since: int
    """Tick of its swap."""
    error: float
    """Mean error before the swap [m]."""
    model_error: float
    """Mean acceleration error of the model before the swap [m/s^2]."""


@dataclass
class RollbackMonitor:
    """Compares the distance from the target before and after swaps; further swaps may occur before the judgement.

    The policies are clearly worse if the mean error of the last half second exceeds both ``least`` and ``factor`` times
    the error before the first swap. The check begins ``settle_s`` after the first swap.
    """

    dt: float
    factor: float = 3.0
    """Largest allowed ratio of the error to the error before the first unproven policy."""
    least: float = 0.1
    """Error below which policies do not count as worse [m]."""
    settle_s: float = 0.5
    """Time after the swap from which the error is checked [s]."""
    watch_s: float = 2.0
    """Flight time after which a policy is proven [s]."""
    surprise: float = 1.0
    """Increase in the model's acceleration error since the swap above which the world counts as changed [m/s^2]."""
    _errors: deque[tuple[float, float]] = field(default_factory=deque)
    _trials: deque[Trial] = field(default_factory=deque)
    _tick: int = 0

    def start_trial(self, version: int) -> None:
        """Record that a new policy is active from now on."""
        if self._errors:
            self._trials.append(Trial(version, self._tick, *self._means()))

    def take(self, error: float, model_error: float) -> Judgement:
        """Process one tick, and judge the unproven policies.

        Args:
            error: Distance from the target [m].
            model_error: Acceleration error of the corrected model [m/s^2].
        """
        self._tick += 1
        self._errors.append((error, model_error))
        while len(self._errors) > max(1, round(0.5 / self.dt)):
            self._errors.popleft()
        if not self._trials:
            return Judgement()
        error, model_error = self._means()
        first = self._trials[0]
        trial_s = (self._tick - first.since) * self.dt
        if model_error > first.model_error + self.surprise:  # the world has changed: errors are not comparable
            last = self._trials[-1].version
            self._trials.clear()
            return Judgement(confirmed_version=last)
        if trial_s >= self.settle_s and error > max(self.factor * first.error, self.least):
            self._trials.clear()
            return Judgement(worse=True)
        if trial_s > self.watch_s:
            return Judgement(confirmed_version=self._trials.popleft().version)
        return Judgement()

    def _means(self) -> tuple[float, float]:
        error, model_error = np.mean(self._errors, axis=0)
        return float(error), float(model_error)
