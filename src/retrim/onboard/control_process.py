"""The control process, which runs one step per tick on a schedule that follows the plant's clock."""

import math
import time

from ..transport.shared_memory import SharedMemoryBus
from .commands import wait_for_take_off
from .control import ControlLoop
from .messages import Stamp, pack_note
from .plan import ControlPlan
from .pulses import Pulses
from .realtime import ParentWatch, be_punctual, sleep_until, wait_until
from .tick_budget import PHASE, ROOM

PATIENCE = ROOM  # of a tick: longest wait for a late sample; the plant then still waits for the answer
SUPERVISOR_TIMEOUT = 5.0  # [s] without a heartbeat from the supervisor, which shares its cores with the learners
LEAD = 0.75 * PHASE  # of a tick, by which the process wakes up before a step is due
LATE = 0.5  # of a tick, after which a step is skipped


class Schedule:
    """Schedules each step shortly after the sample from the plant, whose clock may drift, stop and continue."""

    def __init__(self, epoch: float, dt: float) -> None:
        self._epoch, self._dt, self._tick = epoch, dt, 0
        self._behind = 0

    def next(self) -> float:
        """Return the time of the next step [s]."""
        return self._epoch + (self._tick + PHASE) * self._dt

    def done(self, now: float, sample: Stamp | None) -> None:
        """Record the sample that the step answered, and its lateness."""
        last_answer = self._tick
        if sample is not None:
            drift = sample.send_time - sample.tick * self._dt - self._epoch
            self._behind = self._behind + 1 if drift > PHASE * self._dt else 0
            if self._behind >= 3:  # one late sample does not count; several in a row mean that the plant had stopped
                self._epoch, last_answer, self._behind = self._epoch + drift, sample.tick, 0
            elif drift <= PHASE * self._dt:
                self._epoch += 0.1 * drift
        due = math.floor((now - self._epoch) / self._dt - PHASE - LATE)
        self._tick = max(last_answer, due) + 1


def _ready(loop: ControlLoop, due: float, ahead: float) -> float:
    """Wait for the next step, and rehearse the step if its sample arrives early; return the start time of the step."""
    sleep_until(due - ahead)
    latest = due - 0.5 * ahead
    while not (there := loop.new_sample()) and time.monotonic() < latest:
        time.sleep(1e-4)  # the process that measures may need the core
    if there and time.monotonic() < latest:
        loop.rehearse()
        return wait_until(due)
    sleep_until(due)
    return time.monotonic()


def fly(plan: ControlPlan) -> None:
    """Run the control loop until the flight is over; this is the main function of the process."""
    refusals = be_punctual(plan.priority, set(plan.cores))
    bus, parent = SharedMemoryBus(plan.folder), ParentWatch(plan.parent)
    loop = ControlLoop(plan, bus)
    loop.warm_up()
    bus.publish("ready.control", pack_note("ready", refused=refusals))
    epoch = wait_for_take_off(bus, parent)
    if epoch is None:
        return
    schedule, pulses = Schedule(epoch, plan.dt), Pulses(bus, silence=SUPERVISOR_TIMEOUT)
    pulses.expect("supervisor", within=float("inf"))  # a flight without heartbeats from a supervisor is allowed
    while not loop.over:
        due_time = schedule.next()
        woke = _ready(loop, due_time, LEAD * plan.dt)
        late = not loop.new_sample()
        while not loop.new_sample() and time.monotonic() < due_time + PATIENCE * plan.dt:
            time.sleep(2e-4)
        now = time.monotonic()
        loop.late_samples += late
        loop.tick(now, (woke if late else now) - due_time)  # the wait for a sample does not count as lateness
        if parent.has_ended():
            loop.land("the supervisor is gone")
        elif pulses.hanging(["supervisor"]):
            loop.land(f"the supervisor hangs: it said nothing for {SUPERVISOR_TIMEOUT:g} s")
        loop.idle()
        schedule.done(time.monotonic(), loop.stamp)
    time.sleep(2 * plan.dt)  # the plant reads the last command
