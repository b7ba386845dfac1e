"""The process that goes on commanding when the one that flies has died or hangs: nothing but the fallback."""

import time
from collections import deque
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import MessageError
from ..transport.bus import Bus
from ..transport.shared_memory import SharedMemoryBus
from .accounts import blind_row
from .guard import OVER, Fallback, GeometricHover, Limits, Mode
from .heart import Heart
from .messages import COMMAND, FlightRows, Sample, Setpoint, Stamp, pack_note
from .realtime import Lifeline, be_punctual
from .stalls import Stalls

PATIENCE = 1.6  # ticks without a command
CHECK_EVERY = 0.002  # [s]
ROWS = 50  # of a report: what it saw before it took over, too


@dataclass(frozen=True)
class WatchdogPlan:
    """Everything that the process is started with."""

    folder: Path
    limits: Limits
    dt: float
    home: np.ndarray
    """Where to hold if control never said, world [m]."""
    cores: frozenset[int]
    priority: int
    control: int
    """The process that is watched."""
    parent: int
    """Without it the watchdog ends once the flight has."""


class Watchdog:
    """Decides, tick by tick, whether to command, and what."""

    def __init__(self, plan: WatchdogPlan, bus: Bus) -> None:
        self.plan, self.bus = plan, bus
        self._fallback = Fallback(GeometricHover(plan.limits, plan.dt))
        self.heard: float | None = None
        self.done = False
        self._version = 0
        self._sample: Sample | None = None
        self._stamp: Stamp | None = None
        self._seen = 0
        self._next = 0.0
        self._target = plan.home
        self._rows: deque[np.ndarray] = deque(maxlen=ROWS)
        self._start = 0.0

    def check(self, now: float, gone: bool) -> Setpoint | None:
        """Return the command that was published, if one was due.

        Args:
            now: Monotonic clock [s].
            gone: The process that flies has ended.
        """
        if (message := self.bus.latest("setpoint", self._version)) is not None:
            self._version = message.version
            self._hear(message.data, now)
        new = self._look()
        if self.heard is None and self._sample is not None:
            self.heard = now  # from the first measurement on, somebody has to answer
        silent = self.heard is not None and (gone or now - self.heard > PATIENCE * self.plan.dt)
        if not silent or self.done or not (new or now >= self._next):
            return None
        if self._sample is None or self._stamp is None:
            return None
        self._next = now + 1.5 * self.plan.dt  # at the latest, should no sample come
        fresh = self._sample.age + now - self._sample.sent <= self.plan.limits.state_age
        u, mode = self._fallback.step(self._sample.state, fresh, self._target, land=False)
        self.done = mode in OVER
        setpoint = Setpoint(self._stamp.tick, now, u, self._target, self.done, mode == Mode.DROP)
        self.bus.publish("fallback", setpoint.pack())
        if mode in (Mode.BLIND, Mode.DROP) and not new:
            row = blind_row(self._sample, self._stamp, now, self._start, self.plan.dt, u, mode)
            self._rows.append(row)
        elif self._sample.tick == self._stamp.tick:  # a tick whose state was refused has no row
            self._rows[-1][COMMAND], self._rows[-1][-1] = u, Mode.WATCHDOG
        self.bus.publish("fallback.flight", FlightRows(np.stack(self._rows)).pack())
        return setpoint

    def _hear(self, data: bytes, now: float) -> None:
        """Take note that somebody flies, where the vehicle should be, and whether it has landed."""
        try:
            said = Setpoint.unpack(data)
        except MessageError:
            return
        self.heard = now  # what nobody can fly by is silence
        self._fallback.rest()
        self._target, self.done = said.target, self.done or said.landed

    def _look(self) -> bool:
        """Take a new sample, if there is one; return whether there is one to answer."""
        message = self.bus.latest("sample", self._seen)
        if message is None:
            return False
        self._seen = message.version
        try:
            sample = Sample.unpack(message.data)
        except MessageError:
            return self._look_at_stamp(message.data)
        if self._sample is not None and sample.tick == self._sample.tick + 1:
            self._fallback.hover.feel(self._sample.state, sample.state, sample.accepted)
            self._rows[-1][COMMAND] = sample.accepted
        if self._sample is None:
            self._start = sample.t
        accounts = [0.0, 0.0, 0.0, sample.age, 0.0, Mode.POLICY]
        head = [sample.tick, sample.t - self._start, sample.age]
        self._rows.append(np.concatenate([head, sample.state, sample.truth, sample.accepted, accounts]))
        self._sample, self._stamp = sample, Stamp(sample.tick, sample.sent)
        return True

    def _look_at_stamp(self, data: bytes) -> bool:
        """Take what can be taken of a sample whose state is refused."""
        try:
            self._stamp = Stamp.unpack(data)
        except MessageError:
            return False
        return True


def watch(plan: WatchdogPlan) -> None:
    """Watch until the flight is over: the main function of the process."""
    refused = be_punctual(plan.priority, set(plan.cores))
    bus = SharedMemoryBus(plan.folder)
    watchdog, control, parent = Watchdog(plan, bus), Lifeline(plan.control), Lifeline(plan.parent)
    bus.publish("ready.watchdog", pack_note("ready", refused=refused))
    stalls = None if refused else Stalls(CHECK_EVERY)  # who comes behind others waits for them, not for the machine
    if stalls is not None:
        bus.publish("stalls", stalls.pack())
    heart = Heart(bus, "watchdog")
    while not watchdog.done:
        heart.beat()
        if stalls is not None and watchdog.heard is not None and stalls.woke(time.monotonic()):
            bus.publish("stalls", stalls.pack())
        gone = control.gone(CHECK_EVERY)
        if gone:
            time.sleep(CHECK_EVERY)
            if watchdog.heard is None and parent.gone():
                return
        watchdog.check(time.monotonic(), gone)
