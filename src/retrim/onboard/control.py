"""The control loop, which does the urgent work of each tick first, and other work in the remaining time."""

import contextlib
import time
from collections import deque
from typing import Any

import numpy as np

from ..errors import MessageError, PlantError
from ..transport.bus import Bus
from .guard import FINAL_MODES, UP, Fallback, G, GeometricHover, Mode
from .messages import ACCOUNTS, COMMAND, FlightRows, Sample, Setpoint, Stamp, pack_note, unpack_note
from .parameter_receiver import ParameterReceiver
from .pilot import LivePilot
from .plan import ControlPlan
from .tick_budget import PHASE, ROOM
from .timing_stats import blind_row

REPORT_EVERY = 5  # ticks
GAPS = 100  # number of gaps that are kept, the newest ones
LANDING = "landing"
REHEARSAL_TIME = PHASE / 4  # of a tick: longest duration of a decision that is rehearsed
SMOOTHING = 0.1  # weight of a tick in the running mean of the disturbance


class ControlLoop:
    """Control loop of one flight. :meth:`tick` contains the whole control step, so tests do not need a clock."""

    def __init__(self, plan: ControlPlan, bus: Bus) -> None:
        self.plan, self.bus = plan, bus
        self.pilot = LivePilot(plan.controller)
        self.intake = ParameterReceiver(self.pilot, bus, plan.controller.base, plan.dt)
        self.mode, self.reason = Mode.POLICY, ""
        self.rows: deque[np.ndarray] = deque(maxlen=plan.window)
        self.sample: Sample | None = None
        """Newest measurement."""
        self.stamp: Stamp | None = None
        """Stamp of the newest measurement, even if its state was refused: the plant still waits for an answer."""
        self.over = False
        """Whether the flight has ended and all its ticks have been reported."""
        self.error = 0.0
        self.missed_ticks, self.late_samples = 0, 0  # before the landing
        self.gaps: deque[tuple[float, float, int]] = deque(maxlen=GAPS)
        """Gaps in the ticks: start and end on the monotonic clock [s], and number of missed ticks."""
        self.disturbance, self.estimate = np.zeros(3), np.zeros(3)
        """Running means of the simple model's acceleration error and of the residual model's estimate of this error, in
        the world frame [m/s^2]."""
        self.stages: deque[tuple[float, int, int]] = deque(maxlen=GAPS)
        """Changes of the controller's stage: time since the start [s], stage and cause."""
        self._fallback = Fallback(GeometricHover(plan.limits, plan.dt))
        self._row: np.ndarray | None = None
        self._start, self._command, self._target = 0.0, np.array([]), np.zeros(3)
        self._commands: deque[np.ndarray] = deque(maxlen=plan.delay_ticks + 1)
        self._versions = {"sample": 0, "order": 0, "learning": 0}
        self._landing, self._gap, self._ticks = "", "", 0
        self._end_samples: tuple[Sample, Sample] | None = None
        self._usual = float("inf")  # usual duration of a decision [s]

    def new_sample(self) -> bool:
        """Return whether there is an unanswered measurement."""
        return self.bus.latest("sample", self._versions["sample"]) is not None

    def warm_up(self) -> None:
        """Run every program before the flight so that its first call in flight is not slow.

        Raises:
            PlantError: The controller is too slow for its tick.
        """
        x, took = np.concatenate([np.zeros(3), np.eye(3).ravel(), np.zeros(3)]), list[float]()
        self.pilot.reset(x)
        for i in range(20):
            t, began = self.plan.dt * i, time.monotonic()
            u = self.pilot.act(t, 0.0, x)
            Setpoint(i, began, u, self.pilot.target(t)).pack()
            took.append(time.monotonic() - began)
            self.pilot.accept(u)
            self.pilot.predict(x, u)
            self._fallback.hover.command(x, x[:3])
        self._fallback.rest()
        self._usual = float(np.median(took))
        if self._usual > ROOM * self.plan.dt:
            raise PlantError(
                f"a decision of this controller takes {1e3 * self._usual:.0f} ms here, in NumPy; in a tick of "
                f"{1e3 * self.plan.dt:.0f} ms, at most {1e3 * ROOM * self.plan.dt:.1f} ms are allowed"
            )

    def tick(self, now: float, lateness: float = 0.0) -> Setpoint | None:
        """Read the newest sample, then compute, publish and return the command; return None before the first sample."""
        began, new = time.monotonic(), self._receive()
        sample, stamp = self.sample, self.stamp
        if sample is None or stamp is None:
            return None
        t, age = sample.t - self._start, sample.age + now - sample.send_time
        fresh = age <= self.plan.limits.state_age
        u = self._policy(sample, t, age, new) if self.mode == Mode.POLICY else None
        if u is None:
            u, self.mode = self._fallback.step(sample.state, fresh, self._target, land=bool(self._landing))
            self._command = u if self.mode in FINAL_MODES else self.plan.limits.within(u)
        over, blind = self.mode in FINAL_MODES, self.mode == Mode.DROP
        setpoint = Setpoint(stamp.tick, time.monotonic(), self._command, self._target, over, blind)
        if not setpoint.is_final:
            self.bus.publish("setpoint", setpoint.pack())
        if new:
            phase = self.pilot.task_time(t)
            accounts = [lateness, time.monotonic() - began, 0.0, age, t - self.intake.data_time, phase, self.mode]
            head = [sample.tick, t, sample.age]
            self._row = np.concatenate([head, sample.state, sample.truth, self._command, accounts])
        elif self.mode in (Mode.BLIND, Mode.DROP):
            self._finish_row(None)
            self.rows.append(blind_row(sample, stamp, now, self._start, self.plan.dt, self._command, self.mode))
        if setpoint.is_final:  # publish the ticks first, since the plant and the recorder end at this command
            self._finish_row(None)
            self._publish_rows()
            self.bus.publish("setpoint", setpoint.pack())
        return setpoint

    def rehearse(self) -> None:
        """Repeat the computation for the newest measurement to fill the processor's caches, and discard the result."""
        if (
            (sample := self.sample) is not None
            and self.mode == Mode.POLICY
            and self._usual < REHEARSAL_TIME * self.plan.dt
        ):
            self.pilot.rehearse(sample.t - self._start, sample.age, sample.state)
            self.plan.limits.find_violation(Sample.unpack(sample.pack()).state)

    def idle(self) -> None:
        """Do the work that is not urgent, such as reading orders and new parameters and publishing reports."""
        began = time.monotonic()
        t = 0.0 if self.sample is None else self.sample.t - self._start
        if (order := self._new("order")) is not None and order.get("order") == "land":
            self.land(LANDING)
        if (learning := self._new("learning")) is not None:
            self.intake.open = bool(learning.get("flown", True))
        if t >= self.plan.seconds - 0.5 * self.plan.dt:
            self.land(LANDING)
        self._watch()
        if self.mode == Mode.POLICY:
            self.intake.poll(t)
        self._ticks += 1
        has_end = self.bus.latest("ended") is not None and not self.new_sample()
        self.over = self.mode in FINAL_MODES or has_end
        if self.over:  # no later measurement will report the command that the plant accepted
            self._finish_row(None)
        self._publish_rows()  # on each tick, so the log contains the last tick whenever this process dies
        if self._ticks % REPORT_EVERY == 1 or self.over:
            self.report()
        if self._row is not None:
            self._row[ACCOUNTS["idle"]] += time.monotonic() - began

    def report(self) -> None:
        """Publish the state of the flight."""
        intake = self.intake
        self.bus.publish("status", pack_note(
            "status", mode=self.mode.name.lower(), reason=self.reason, error=self.error, versions=self.pilot.versions,
            newest=intake.newest, given_up=intake.withdrawals, refused=intake.refusals, swaps=list(intake.swaps),
            missed=self.missed_ticks, gaps=list(self.gaps), late_samples=self.late_samples,
            disturbance=self.disturbance.tolist(), estimate=self.estimate.tolist(),
            target=self._target.tolist(), learning=self.intake.open,
            stages=list(self.stages),
        ))  # fmt: skip

    def land(self, reason: str) -> None:
        """Start the landing, and record the reason unless one is already recorded."""
        self._landing = self._landing or reason

    def _policy(self, sample: Sample, t: float, age: float, new: bool) -> np.ndarray | None:
        """Return the policy's command; if the policy must no longer fly, record the reason and return None."""
        limits = self.plan.limits
        wrong = self._landing or self._gap
        if age > limits.state_age:
            wrong = wrong or f"the newest measurement is {age:.3f} s old"
        wrong = wrong or limits.find_violation(sample.state) or ""
        if t - self.intake.data_time > limits.policy_age:
            wrong = wrong or f"the policy was learned {t - self.intake.data_time:.1f} s ago"
        if not wrong and not new and len(self._command):
            return self._command
        if not wrong:
            stage = self.pilot.condition[0]
            u, target = self.pilot.act(t, sample.age, sample.state), self._aim(t)
            if self.pilot.condition[0] != stage:
                self.stages.append((t, *self.pilot.condition))
            if target and np.isfinite(u).all():
                self._command = self.plan.limits.within(u)
                if (self._command != u).any():
                    self.pilot.accept(self._command)
                self.error = float(np.linalg.norm(sample.state[:3] - self._target))
                return self._command
            wrong = "the policy's command is not finite" if target else "the target is not finite"
        self.mode, self.reason = Mode.HOLD, wrong
        return None

    def _aim(self, t: float) -> bool:
        """Update the target position if the new one is finite; return whether it is finite."""
        target = self.pilot.target(t)
        if finite := bool(np.isfinite(target).all()):
            self._target = target
        return finite

    def _receive(self) -> bool:
        message = self.bus.latest("sample", self._versions["sample"])
        if message is None:
            return False
        self._versions["sample"] = message.version
        try:
            sample = Sample.unpack(message.data)
        except MessageError:
            self.intake.refuse("sample")
            with contextlib.suppress(MessageError):
                self.stamp = Stamp.unpack(message.data)
            return False
        before = self.sample
        if before is None:
            self._start = sample.t
            self.pilot.reset(sample.state)
            self._target = sample.state[:3]
            self._aim(0.0)
        elif sample.tick <= before.tick:
            self.intake.refuse("stale sample")
            return False
        else:
            self._follow(before, sample)
        self.sample, self.stamp = sample, Stamp(sample.tick, sample.send_time)
        return True

    def _follow(self, before: Sample, sample: Sample) -> None:
        """Process the accepted command and the number of missed ticks since the previous sample."""
        accepted_u, lost_ticks = np.asarray(sample.accepted), sample.tick - before.tick - 1
        if lost_ticks and not self._landing:
            self.missed_ticks += lost_ticks
            self.gaps.append((before.send_time, sample.send_time, lost_ticks))
        if lost_ticks * self.plan.dt > self.plan.limits.state_age:
            self._gap = f"{lost_ticks} measurements were not answered"
        if self.mode == Mode.POLICY and np.abs(accepted_u - self._command).max() > 1e-4:
            self.pilot.accept(accepted_u)
        self._finish_row(None if lost_ticks else accepted_u)
        self._commands.append(accepted_u)
        self._end_samples = None if lost_ticks else (before, sample)

    def _watch(self) -> None:
        """Evaluate the model errors and the distance from the target over the past tick."""
        if self._end_samples is None:
            return
        (before, sample), self._end_samples = self._end_samples, None
        self._fallback.hover.feel(before.state, sample.state, self._commands[0])
        if self.mode == Mode.POLICY:
            a = (sample.state[12:] - before.state[12:]) / self.plan.dt
            prediction = self.pilot.predict(before.state, self._commands[0])
            simple = self._commands[0][0] * before.state[[5, 8, 11]] - G * UP
            self.disturbance += SMOOTHING * (a - simple - self.disturbance)
            self.estimate += SMOOTHING * (prediction - simple - self.estimate)
            model_error = float(np.linalg.norm(a - prediction))
            target = self.pilot.target(sample.t - self._start)
            self.intake.watch(float(np.linalg.norm(sample.state[:3] - target)), model_error)

    def _finish_row(self, accepted_u: np.ndarray | None) -> None:
        """Add the last tick to the report, with the command that the plant accepted if that command is known."""
        if self._row is None:
            return
        if accepted_u is not None:
            self._row[COMMAND] = accepted_u
        self.rows.append(self._row)
        self._row = None

    def _publish_rows(self) -> None:
        if self.rows:
            self.bus.publish("flight", FlightRows(np.stack(self.rows)).pack())

    def _new(self, topic: str) -> dict[str, Any] | None:
        message = self.bus.latest(topic, self._versions[topic])
        if message is None:
            return None
        self._versions[topic] = message.version
        try:
            return unpack_note(message.data, topic)
        except MessageError:
            self.intake.refuse(topic)
            return None
