"""One flight of a fleet: its specification, and what it leaves."""

from collections.abc import Hashable
from dataclasses import dataclass

import numpy as np
from jax import random
from jaxtyping import Array, Key

from ..adapt.learner import LearnerState
from ..config.scenario import Scenario
from ..runtime.events import Event
from ..runtime.flight import Log

SETTLED = 0.05  # [m]
LONGEST_SHIFT = 3.0  # [s], half of the longest lap of the paper
AS_GOOD, AS_GOOD_M = 0.02, 1e-3  # as a share, and [m]: shifts whose errors differ by less are as good as each other
LEARNER_TAG = 2**30 + 2  # folded into a seed: learners share no key with training, starts and disturbances


@dataclass(frozen=True)
class FlightSpec:
    """One flight to fly."""

    scenario: Scenario
    method: str
    start: int
    """Number of the start; it also seeds the learners, the gusts and the noise of the flight."""
    seed: int = 0
    """Seed of the policy; it also seeds all that ``start`` does."""

    @property
    def group(self) -> tuple[Hashable, str]:
        """Key of the flights that one program can fly: they differ in numbers, start and seed only."""
        return self.scenario.without_numbers(), self.method

    def key(self) -> Key[Array, ""]:
        """Return the key of the flight's learners."""
        return random.fold_in(random.fold_in(random.key(self.seed), LEARNER_TAG), self.start)

    @property
    def plant_seed(self) -> int:
        """Seed of the plant: the same gusts and noise for every method that flies from a start."""
        return 1000 * self.seed + self.start


@dataclass(frozen=True)
class Flight:
    """One flight flown."""

    spec: FlightSpec
    vehicle: str
    """Name of the vehicle that flew."""
    log: Log
    error: np.ndarray
    """The task's error in each row of the log [m]."""
    metric: str
    """Name of the error."""
    steady_seconds: float
    """The flight is scored over this long at its end [s]."""
    cross: np.ndarray | None = None
    """Distance from the nearest point of the reference in each row [m], if the task has one."""
    learnt: LearnerState | None = None
    """What a flight that adapted has learnt."""
    target: np.ndarray | None = None
    """Where the vehicle should have been in each row, world [m]."""

    @property
    def steady(self) -> float:
        """Mean error over the last seconds [m]; NaN for a flight that was terminated."""
        return self._last(self.error)

    @property
    def peak(self) -> float:
        """Largest error after the first 5 s [m]; infinite for a flight that was terminated."""
        return float("inf") if self.log.terminated else float(self.error[self._after_start()].max())

    @property
    def late(self) -> float:
        """Mean error after the first 5 s [m]; infinite for a flight that was terminated."""
        return float("inf") if self.log.terminated else float(self.error[self._after_start()].mean())

    @property
    def settle_s(self) -> float:
        """Time after which the error stays below 5 cm [s]; infinite if it does not."""
        outside = np.flatnonzero(self.error >= SETTLED)
        if self.log.terminated or (len(outside) and outside[-1] == len(self.error) - 1):
            return float("inf")
        return float(self.log.t[outside[-1] + 1]) if len(outside) else 0.0

    @property
    def behind(self) -> tuple[float, float] | None:
        """Return by how much the flight is behind its reference [s], and the mean error but for that [m].

        It is the constant shift in time, of 3 s at most, with the smallest mean error over the last seconds; of shifts
        that are as good, as those of a lap are, the smallest. None for a flight that was terminated or follows nothing.
        """
        if self.cross is None or self.target is None or self.log.terminated:
            return None
        rows = np.flatnonzero(self._late_rows())
        most = min(round(LONGEST_SHIFT / self.log.dt), int(rows[0]), len(rows) // 2)
        rows = rows[rows + most < len(self.target)]  # the same for every shift, or they could not be compared
        shifts, errors = sorted(range(-most, most + 1), key=abs), list[float]()
        for k in shifts:
            errors.append(float(np.linalg.norm(self.log.p[rows] - self.target[rows - k], axis=1).mean()))
        best = int(np.argmax(np.array(errors) <= (1.0 + AS_GOOD) * min(errors) + AS_GOOD_M))
        return shifts[best] * self.log.dt, errors[best] if shifts[best] else self.steady

    @property
    def effort(self) -> tuple[float, float]:
        """Return the commanded body rates, and by how much they change in a tick, both root mean square [rad/s].

        After the first 5 s; NaN for a flight that was terminated.
        """
        if self.log.terminated:
            return float("nan"), float("nan")
        rates = self.log.u[self._after_start(), 1:]
        change = np.diff(rates, axis=0)
        return float(np.sqrt(np.mean(np.sum(rates**2, axis=1)))), float(np.sqrt(np.mean(np.sum(change**2, axis=1))))

    @property
    def cross_track(self) -> float | None:
        """Mean cross-track error over the last seconds [m]; None for a task without one."""
        return None if self.cross is None else self._last(self.cross)

    @property
    def swaps(self) -> tuple[float, ...]:
        """Times at which a new policy took over [s]; a live one may do so while landing, which is no part of this."""
        return tuple(e.t for e in self.log.events if e.kind == "policy" and e.t <= self.log.t[-1])

    @property
    def events(self) -> tuple[Event, ...]:
        """What adaptation did."""
        return self.log.events

    def _after_start(self) -> np.ndarray:
        """Rows after the flight to the goal; a short flight is halved."""
        rows: np.ndarray = self.log.t >= min(5.0, self.log.t[-1] / 2)
        return rows

    def _late_rows(self) -> np.ndarray:
        """Rows of the last seconds, by time: a tick may be missed."""
        rows: np.ndarray = self.log.t > self.log.t[-1] - self.steady_seconds + 0.5 * self.log.dt
        return rows

    def _last(self, error: np.ndarray) -> float:
        return float("nan") if self.log.terminated else float(error[self._late_rows()].mean())
