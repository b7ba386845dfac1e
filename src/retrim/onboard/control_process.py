"""The process that flies: one step per tick, by a clock of its own that keeps to the plant's."""

import math
import time

from ..transport.shared_memory import SharedMemoryBus
from .control import ControlLoop
from .messages import Stamp, pack_note
from .orders import wait_for_take_off
from .plan import ControlPlan
from .pulses import Pulses
from .realtime import Lifeline, be_punctual, sleep_until, wait_until
from .shares import PHASE, ROOM

PATIENCE = ROOM  # of a tick, for which a late sample is waited for: then its sender still waits for the answer
ALONE = 5.0  # [s] without a heartbeat of the supervisor, which shares its cores with those who learn
AHEAD = 0.75 * PHASE  # of a tick, by which the process is awake before a step is due
LATE = 0.5  # of a tick, after which a step is left out


class Schedule:
    """When steps are due: shortly after the samples of the plant, whose clock may drift, stop and go on."""

    def __init__(self, epoch: float, dt: float) -> None:
        self._epoch, self._dt, self._tick = epoch, dt, 0
        self._behind = 0

    def next(self) -> float:
        """Return when the next step is due [s]."""
        return self._epoch + (self._tick + PHASE) * self._dt

    def done(self, now: float, sample: Stamp | None) -> None:
        """Take note of the sample that the step answered, and of how late it is."""
        answered = self._tick
        if sample is not None:
            drift = sample.sent - sample.tick * self._dt - self._epoch
            self._behind = self._behind + 1 if drift > PHASE * self._dt else 0
            if self._behind >= 3:  # one late sample is a late sample; if all are, the plant stood still
                self._epoch, answered, self._behind = self._epoch + drift, sample.tick, 0
            elif drift <= PHASE * self._dt:
                self._epoch += 0.1 * drift
        due = math.floor((now - self._epoch) / self._dt - PHASE - LATE)
        self._tick = max(answered, due) + 1


def _ready(loop: ControlLoop, due: float, ahead: float) -> float:
    """Wait for a step that is due, and rehearse it if its sample is there early enough; return when it can begin."""
    sleep_until(due - ahead)
    latest = due - 0.5 * ahead
    while not (there := loop.new_sample()) and time.monotonic() < latest:
        time.sleep(1e-4)  # whoever measures may need the core
    if there and time.monotonic() < latest:
        loop.rehearse()
        return wait_until(due)
    sleep_until(due)
    return time.monotonic()


def fly(plan: ControlPlan) -> None:
    """Fly until the vehicle has landed: the main function of the process."""
    refused = be_punctual(plan.priority, set(plan.cores))
    bus, parent = SharedMemoryBus(plan.folder), Lifeline(plan.parent)
    loop = ControlLoop(plan, bus)
    loop.warm_up()
    bus.publish("ready.control", pack_note("ready", refused=refused))
    epoch = wait_for_take_off(bus, parent)
    if epoch is None:
        return
    schedule, pulses = Schedule(epoch, plan.dt), Pulses(bus, silence=ALONE)
    pulses.expect("supervisor", within=float("inf"))  # nobody else may be there to beat
    while not loop.over:
        scheduled = schedule.next()
        woke = _ready(loop, scheduled, AHEAD * plan.dt)
        late = not loop.new_sample()
        while not loop.new_sample() and time.monotonic() < scheduled + PATIENCE * plan.dt:
            time.sleep(2e-4)
        now = time.monotonic()
        loop.late_samples += late
        loop.tick(now, (woke if late else now) - scheduled)  # what the step waits for is not its own lateness
        if parent.gone():
            loop.land("the supervisor is gone")
        elif pulses.hanging(["supervisor"]):
            loop.land(f"the supervisor hangs: it said nothing for {ALONE:g} s")
        loop.idle()
        schedule.done(time.monotonic(), loop.stamp)
    time.sleep(2 * plan.dt)  # the last command is taken
