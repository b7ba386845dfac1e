"""Defines the specification and the results of one flight of a fleet."""

from collections.abc import Hashable
from dataclasses import dataclass

import numpy as np
from jax import random
from jaxtyping import Array, Key

from ..adapt.learner_state import LearnerState
from ..config.scenario import Scenario
from ..runtime.events import Event
from ..runtime.flight import Log

SETTLING_ERROR = 0.05  # [m]
LONGEST_SHIFT = 3.0  # [s], half of the paper's longest lap
TIE_SHARE, TIE_M = 0.02, 1e-3  # as a share, and [m]: shifts whose errors differ by less count as equally good
LEARNER_TAG = 2**30 + 2  # folded into a seed, so that learners do not share keys with training, starts or disturbances


@dataclass(frozen=True)
class FlightSpec:
    """One flight to fly."""

    scenario: Scenario
    method: str
    start: int
    """Number of the start; it also seeds the learners, gusts and noise of the flight."""
    seed: int = 0
    """The policy's seed; together with ``start``, it also seeds the learners, gusts and noise."""

    @property
    def group(self) -> tuple[Hashable, str]:
        """Key of the flights that can share a program: they differ only in numbers, start and seed."""
        return self.scenario.without_numbers(), self.method

    def key(self) -> Key[Array, ""]:
        """Return the random key for the flight's learners."""
        return random.fold_in(random.fold_in(random.key(self.seed), LEARNER_TAG), self.start)

    @property
    def plant_seed(self) -> int:
        """Seed of the plant, which gives all methods the same gusts and noise at the same start."""
        return 1000 * self.seed + self.start


@dataclass(frozen=True)
class Flight:
    """A completed flight."""

    spec: FlightSpec
    vehicle: str
    """Name of the vehicle."""
    log: Log
    error: np.ndarray
    """The task's error in each row of the log [m]."""
    metric: str
    """Name of the error."""
    steady_seconds: float
    """Length of the scored interval at the end of the flight [s]."""
    cross: np.ndarray | None = None
    """Distance from the nearest point on the reference in each row [m], if the task has a reference."""
    learner_state: LearnerState | None = None
    """Learner state at the end of an adapting flight."""
    target: np.ndarray | None = None
    """The vehicle's target position in each row, in the world frame [m]."""

    def __repr__(self) -> str:
        """Return the conditions and the errors, in one line."""
        spec, log = self.spec, self.log
        error = "terminated" if log.terminated else f"error {self.steady:.2g} m at the end, {self.peak:.2g} m at most"
        return (
            f"Flight: {self.vehicle}, {spec.scenario.disturbance}, {spec.method}, seed {spec.seed}, "
            f"start {spec.start}: {log.t[-1]:.2f} s, {error}"
        )

    @property
    def steady(self) -> float:
        """Mean error over the last few seconds [m]; NaN for a flight that was terminated."""
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
        """Time from which the error stays below 5 cm [s]; infinite if it does not."""
        outside = np.flatnonzero(self.error >= SETTLING_ERROR)
        if self.log.terminated or (len(outside) and outside[-1] == len(self.error) - 1):
            return float("inf")
        return float(self.log.t[outside[-1] + 1]) if len(outside) else 0.0

    @property
    def behind(self) -> tuple[float, float] | None:
        """Lag of the flight behind its reference [s], and the flight's mean error without this lag [m].

        The lag is the constant time shift, of at most 3 s, with the smallest mean error over the last few seconds. If
        several shifts are equally good, for example on a lap, the lag is the smallest of them. The result is None for a
        terminated flight, or for a task without a reference.
        """
        if self.cross is None or self.target is None or self.log.terminated:
            return None
        rows = np.flatnonzero(self._late_rows())
        most = min(round(LONGEST_SHIFT / self.log.dt), int(rows[0]), len(rows) // 2)
        rows = rows[rows + most < len(self.target)]  # the same rows for every shift, so that errors are comparable
        shifts, errors = sorted(range(-most, most + 1), key=abs), list[float]()
        for k in shifts:
            errors.append(float(np.linalg.norm(self.log.p[rows] - self.target[rows - k], axis=1).mean()))
        best = int(np.argmax(np.array(errors) <= (1.0 + TIE_SHARE) * min(errors) + TIE_M))
        return shifts[best] * self.log.dt, errors[best] if shifts[best] else self.steady

    @property
    def effort(self) -> tuple[float, float]:
        """Root mean squares of the commanded body rates and of their change per tick [rad/s].

        Both cover the time after the first 5 s, and are NaN for a flight that was terminated.
        """
        if self.log.terminated:
            return float("nan"), float("nan")
        rates = self.log.u[self._after_start(), 1:]
        change = np.diff(rates, axis=0)
        return float(np.sqrt(np.mean(np.sum(rates**2, axis=1)))), float(np.sqrt(np.mean(np.sum(change**2, axis=1))))

    @property
    def cross_track(self) -> float | None:
        """Mean cross-track error over the last few seconds [m]; None for a task without one."""
        return None if self.cross is None else self._last(self.cross)

    @property
    def swaps(self) -> tuple[float, ...]:
        """Times at which a new policy took over [s], except those after the log ends, when a live flight lands."""
        return tuple(e.t for e in self.log.events if e.kind == "policy" and e.t <= self.log.t[-1])

    @property
    def events(self) -> tuple[Event, ...]:
        """Events in the flight, such as adaptation events."""
        return self.log.events

    def _after_start(self) -> np.ndarray:
        """Return the rows after the flight to the goal: after 5 s, or after half of a shorter flight."""
        rows: np.ndarray = self.log.t >= min(5.0, self.log.t[-1] / 2)
        return rows

    def _late_rows(self) -> np.ndarray:
        """Return the rows of the last few seconds; they are selected by time, since a tick may be missed."""
        rows: np.ndarray = self.log.t > self.log.t[-1] - self.steady_seconds + 0.5 * self.log.dt
        return rows

    def _last(self, error: np.ndarray) -> float:
        return float("nan") if self.log.terminated else float(error[self._late_rows()].mean())
