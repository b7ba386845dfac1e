"""What the process that flies does each tick, and what is not urgent in the time that is left."""

import time
from collections import deque
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import MessageError
from ..transport.bus import Bus
from .guard import Fallback, GeometricHover, Limits, Mode
from .messages import COMMAND, FlightRows, Parameters, Sample, Setpoint, pack_note, unpack_note
from .pilot import ControllerSource, LivePilot
from .rollback import FlownError

REPORT_EVERY = 5  # ticks


@dataclass(frozen=True)
class ControlPlan:
    """Everything that the process is started with."""

    folder: Path
    """Of the bus."""
    controller: ControllerSource
    limits: Limits
    low: np.ndarray
    """Smallest command that the vehicle takes."""
    high: np.ndarray
    """Largest one."""
    dt: float
    delay_ticks: int
    """Declared command delay of the plant."""
    window: int
    """Ticks that are published for those who learn and for the log."""
    floor: float
    """Height at which the vehicle has landed [m]."""
    cores: frozenset[int]
    priority: int
    parent: int
    """Process whose end lands the vehicle."""


class ControlLoop:
    """One flight. :meth:`tick` is the whole of it, so that a test needs no clock."""

    def __init__(self, plan: ControlPlan, bus: Bus) -> None:
        self.plan, self.bus = plan, bus
        self.pilot = LivePilot(plan.controller)
        self.mode, self.reason = Mode.POLICY, ""
        self.rows: deque[np.ndarray] = deque(maxlen=plan.window)
        self.error = 0.0
        self.missed, self.late_samples, self.rolled_back = 0, 0, [0]
        self.refused: dict[str, int] = {}
        self.swaps: deque[list[Any]] = deque(maxlen=20)
        self._fallback = Fallback(GeometricHover(plan.low, plan.high, plan.dt), plan.floor)
        self._flown = FlownError(plan.dt)
        self._sample: Sample | None = None
        self._start, self._issued = 0.0, np.array([])
        self._commands: deque[np.ndarray] = deque(maxlen=plan.delay_ticks + 1)
        self._known = {"sample": 0, "order": 0} | {f"parameters.{half}": 0 for half in plan.controller.parameters}
        self._landing, self._learnt, self._ticks = False, 0.0, 0

    @property
    def sample(self) -> Sample | None:
        """The newest measurement."""
        return self._sample

    def new_sample(self) -> bool:
        """Return whether there is one that has not been answered."""
        return self.bus.latest("sample", self._known["sample"]) is not None

    def warm_up(self) -> None:
        """Touch everything once, before it is urgent."""
        x = np.concatenate([np.zeros(3), np.eye(3).ravel(), np.zeros(3)])
        self.pilot.reset(x)
        for i in range(20):
            self.pilot.predicted(x, self.pilot.act(self.plan.dt * i, 0.0, x))
            self.pilot.target(0.0)
            self._fallback.hover.command(x, x[:3])
        self._fallback.hover.integral[:] = 0.0

    def tick(self, now: float, lateness: float = 0.0) -> Setpoint | None:
        """Take the newest sample, decide, and return what was published; None before the first sample."""
        began, new = time.monotonic(), self._receive()
        sample = self._sample
        if sample is None:
            return None
        t, age = sample.t - self._start, sample.age + now - sample.sent
        fresh = age <= self.plan.limits.state_age
        if self.mode == Mode.POLICY:
            wrong = None if fresh else f"the newest measurement is {age:.3f} s old"
            wrong = wrong or self.plan.limits.broken(sample.state)
            if t - self._learnt > self.plan.limits.policy_age:
                wrong = wrong or f"the policy was learnt {t - self._learnt:.1f} s ago"
            u = self._issued if not new and len(self._issued) else None
            if wrong is None and u is None:
                u = self.pilot.act(t, sample.age, sample.state)
                wrong = None if np.isfinite(u).all() else "the policy's command is not finite"
            if wrong or self._landing:
                self.mode, self.reason = Mode.HOLD, wrong or "landing"
        if self.mode != Mode.POLICY:
            u, self.mode = self._fallback.step(sample.state, fresh, self.pilot.target(t), land=self._landing)
        assert u is not None
        self._issued = np.clip(u, self.plan.low, self.plan.high) if self.mode != Mode.LANDED else u
        setpoint = Setpoint(sample.tick, time.monotonic(), self._issued, self.mode == Mode.LANDED)
        self.bus.publish("setpoint", setpoint.pack())
        if new:
            self.error = float(np.linalg.norm(sample.state[:3] - self.pilot.target(t)))
            self._note(sample, t, lateness, time.monotonic() - began)
        return setpoint

    def idle(self) -> None:
        """Do what is not urgent: orders, new parameters, reports."""
        if (order := self._new("order")) is not None and order.get("order") == "land":
            self._landing = True
        for half in self.plan.controller.parameters:
            self._poll(half)
        self._ticks += 1
        if self.rows:  # each tick, so that the log has the last one, whenever this process dies
            self.bus.publish("flight", FlightRows(np.stack(self.rows)).pack())
        if self._ticks % REPORT_EVERY == 1 or self.mode == Mode.LANDED:
            self.report()

    def report(self) -> None:
        """Publish the state of the flight."""
        self.bus.publish("status", pack_note("status", **self._status()))

    def _status(self) -> dict[str, Any]:
        return {
            "mode": self.mode.name.lower(),
            "reason": self.reason,
            "error": self.error,
            "versions": self.pilot.versions,
            "missed": self.missed,
            "late_samples": self.late_samples,
            "refused": self.refused,
            "rolled_back": self.rolled_back,
            "swaps": list(self.swaps),
        }

    def land(self, reason: str) -> None:
        """Land from now on."""
        if not self._landing:
            self._landing, self.reason = True, reason

    def _receive(self) -> bool:
        message = self.bus.latest("sample", self._known["sample"])
        if message is None:
            return False
        self._known["sample"] = message.version
        try:
            sample = Sample.unpack(message.data)
        except MessageError:
            self._refuse("sample")
            return False
        if self._sample is None:
            self._start = sample.t
            self.pilot.reset(sample.state)
        elif sample.tick <= self._sample.tick:
            self._refuse("stale sample")
            return False
        elif len(self._issued):
            accepted = np.asarray(sample.accepted)
            if np.abs(accepted - self._issued).max() > 1e-4:
                self.pilot.accepted(accepted)
                if self.rows:
                    self.rows[-1][COMMAND] = accepted
            self._watch(sample, accepted)
        self._sample = sample
        return True

    def _watch(self, sample: Sample, accepted: np.ndarray) -> None:
        """Compare flown and predicted, and take the policy back if it is clearly worse."""
        before = self._sample
        assert before is not None
        self._commands.append(accepted)
        if sample.tick == before.tick + 1:
            self._fallback.hover.feel(before.state, sample.state, self._commands[0])
        if self.mode != Mode.POLICY or sample.tick != before.tick + 1:
            return
        a = (sample.state[12:] - before.state[12:]) / self.plan.dt
        missed = float(np.linalg.norm(a - self.pilot.predicted(before.state, self._commands[0])))
        error = float(np.linalg.norm(sample.state[:3] - self.pilot.target(sample.t - self._start)))
        if self._flown.worse(error, missed) and (version := self.pilot.back("policy")) is not None:
            self.rolled_back.append(version)

    def _poll(self, half: str) -> None:
        """Take new parameters of a half, if there are any that may be used."""
        topic = f"parameters.{half}"
        message = self.bus.latest(topic, self._known[topic])
        if message is None:
            return
        self._known[topic] = message.version
        try:
            found = Parameters.unpack(
                message.data, self.pilot.expected(half), half=half, base=self.plan.controller.base,
                after=max(self.pilot.versions[half], self.rolled_back[-1] if half == "policy" else 0),
            )  # fmt: skip
        except MessageError as error:
            self._refuse(str(error).split(":")[0] if "stale" not in str(error) else f"stale {half}")
            return
        self.pilot.swap(found)
        now = 0.0 if self._sample is None else self._sample.t - self._start
        self.swaps.append([now, half, found.version, now - found.computed_from])
        if half == "policy":
            self._learnt = found.computed_from
            self._flown.swapped()

    def _new(self, topic: str) -> dict[str, Any] | None:
        message = self.bus.latest(topic, self._known[topic])
        if message is None:
            return None
        self._known[topic] = message.version
        try:
            return unpack_note(message.data, topic)
        except MessageError:
            self._refuse(topic)
            return None

    def _refuse(self, what: str) -> None:
        self.refused[what] = self.refused.get(what, 0) + 1

    def _note(self, sample: Sample, t: float, lateness: float, duration: float) -> None:
        head, tail = [sample.tick, t, sample.age], [lateness, duration, self.mode]
        self.rows.append(np.concatenate([head, sample.state, sample.truth, self._issued, tail]))
