"""The watchdog process, which runs only the fallback and sends commands if the control process has died or hangs."""

import time
from collections import deque
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import MessageError
from ..transport.bus import Bus
from ..transport.shared_memory import SharedMemoryBus
from .guard import FINAL_MODES, Fallback, GeometricHover, Limits, Mode
from .heartbeat import Heart
from .messages import COMMAND, FlightRows, Sample, Setpoint, Stamp, pack_note
from .realtime import ParentWatch, be_punctual
from .stalls import Stalls
from .timing_stats import blind_row

PATIENCE = 1.6  # ticks without a command
CHECK_EVERY = 0.002  # [s]
ROWS = 50  # rows of a report, including ticks before the takeover


@dataclass(frozen=True)
class WatchdogPlan:
    """Start parameters of the watchdog process."""

    folder: Path
    limits: Limits
    dt: float
    home: np.ndarray
    """Position in the world frame that the vehicle holds if control has never sent a target [m]."""
    cores: frozenset[int]
    priority: int
    control: int
    """Process id of the control process, which the watchdog watches."""
    parent: int
    """Process id of the supervisor; the watchdog ends if the supervisor and control end before the first sample."""


class Watchdog:
    """Decides whether a command is due, and computes the command."""

    def __init__(self, plan: WatchdogPlan, bus: Bus) -> None:
        self.plan, self.bus = plan, bus
        self._fallback = Fallback(GeometricHover(plan.limits, plan.dt))
        self.last_message: float | None = None
        self.done = False
        self._version = 0
        self._sample: Sample | None = None
        self._stamp: Stamp | None = None
        self._last_version = 0
        self._next = 0.0
        self._target = plan.home
        self._rows: deque[np.ndarray] = deque(maxlen=ROWS)
        self._start = 0.0

    def check(self, now: float, control_ended: bool) -> Setpoint | None:
        """Publish and return a command if one is due.

        Args:
            now: Current time of the monotonic clock [s].
            control_ended: Whether the control process has ended.
        """
        if (message := self.bus.latest("setpoint", self._version)) is not None:
            self._version = message.version
            self._hear(message.data, now)
        new = self._look()
        if self.last_message is None and self._sample is not None:
            self.last_message = now  # the first measurement already needs an answer
        silent = self.last_message is not None and (control_ended or now - self.last_message > PATIENCE * self.plan.dt)
        if not silent or self.done or not (new or now >= self._next):
            return None
        if self._sample is None or self._stamp is None:
            return None
        self._next = now + 1.5 * self.plan.dt  # latest time, in case no sample arrives
        fresh = self._sample.age + now - self._sample.send_time <= self.plan.limits.state_age
        u, mode = self._fallback.step(self._sample.state, fresh, self._target, land=False)
        self.done = mode in FINAL_MODES
        setpoint = Setpoint(self._stamp.tick, now, u, self._target, self.done, mode == Mode.DROP)
        self.bus.publish("fallback", setpoint.pack())
        if mode in (Mode.BLIND, Mode.DROP) and not new:
            row = blind_row(self._sample, self._stamp, now, self._start, self.plan.dt, u, mode)
            self._rows.append(row)
        elif self._sample.tick == self._stamp.tick:  # a tick with a refused state does not have a row
            self._rows[-1][COMMAND], self._rows[-1][-1] = u, Mode.WATCHDOG
        self.bus.publish("fallback.flight", FlightRows(np.stack(self._rows)).pack())
        return setpoint

    def _hear(self, data: bytes, now: float) -> None:
        """Record a command from the control process: its time, the target, and whether the vehicle has landed."""
        try:
            setpoint = Setpoint.unpack(data)
        except MessageError:
            return
        self.last_message = now  # an unreadable command returns above, and so counts as silence
        self._fallback.rest()
        self._target, self.done = setpoint.target, self.done or setpoint.is_final

    def _look(self) -> bool:
        """Read a new sample if one has arrived; return whether it needs an answer."""
        message = self.bus.latest("sample", self._last_version)
        if message is None:
            return False
        self._last_version = message.version
        try:
            sample = Sample.unpack(message.data)
        except MessageError:
            return self._look_at_stamp(message.data)
        if self._sample is not None and sample.tick == self._sample.tick + 1:
            self._fallback.hover.feel(self._sample.state, sample.state, sample.accepted)
            self._rows[-1][COMMAND] = sample.accepted
        if self._sample is None:
            self._start = sample.t
        t = sample.t - self._start
        accounts = [0.0, 0.0, 0.0, sample.age, 0.0, t, Mode.POLICY]
        head = [sample.tick, t, sample.age]
        self._rows.append(np.concatenate([head, sample.state, sample.truth, sample.accepted, accounts]))
        self._sample, self._stamp = sample, Stamp(sample.tick, sample.send_time)
        return True

    def _look_at_stamp(self, data: bytes) -> bool:
        """Read the stamp of a sample with a refused state; return whether it is readable."""
        try:
            self._stamp = Stamp.unpack(data)
        except MessageError:
            return False
        return True


def watch(plan: WatchdogPlan) -> None:
    """Watch until the flight is over; this is the main function of the process."""
    refusals = be_punctual(plan.priority, set(plan.cores))
    bus = SharedMemoryBus(plan.folder)
    watchdog, control, parent = Watchdog(plan, bus), ParentWatch(plan.control), ParentWatch(plan.parent)
    bus.publish("ready.watchdog", pack_note("ready", refused=refusals))
    # Without real-time priority the process also waits for other processes, which is not a stall of the machine.
    stalls = None if refusals else Stalls(CHECK_EVERY)
    if stalls is not None:
        bus.publish("stalls", stalls.pack())
    heart = Heart(bus, "watchdog")
    while not watchdog.done:
        heart.beat()
        if stalls is not None and watchdog.last_message is not None and stalls.woke(time.monotonic()):
            bus.publish("stalls", stalls.pack())
        control_ended = control.has_ended(CHECK_EVERY)
        if control_ended:
            time.sleep(CHECK_EVERY)
            if watchdog.last_message is None and parent.has_ended():
                return
        watchdog.check(time.monotonic(), control_ended)
