"""The process that flies: one step per tick, by a clock of its own that keeps to the plant's."""

import math
import time

from ..transport.shared_memory import SharedMemoryBus
from .control import ControlLoop, ControlPlan
from .guard import Mode
from .messages import Sample, pack_note
from .orders import wait_for_take_off
from .realtime import Lifeline, be_punctual, sleep_until

PHASE = 0.002  # [s] after the plant's tick
PATIENCE = 0.005  # [s] that a late sample is waited for


class Schedule:
    """When steps are due: shortly after the samples of the plant, whose clock may drift, stop and go on."""

    def __init__(self, epoch: float, dt: float) -> None:
        self._epoch, self._dt, self._tick = epoch, dt, 0

    def next(self) -> float:
        """Return when the next step is due [s]."""
        return self._epoch + self._tick * self._dt + PHASE

    def done(self, now: float, sample: Sample | None) -> int:
        """Take note of the sample that the step answered; return how many steps should have begun since."""
        answered = self._tick
        if sample is not None:
            drift = sample.sent - sample.tick * self._dt - self._epoch
            if drift > PHASE:  # the plant stood still
                self._epoch, answered = self._epoch + drift, sample.tick
            else:
                self._epoch += 0.1 * drift
        due = math.floor((now - self._epoch - PHASE) / self._dt)
        missed = max(0, due - answered)
        self._tick = answered + missed + 1
        return missed


def fly(plan: ControlPlan) -> None:
    """Fly until the vehicle has landed: the main function of the process."""
    refused = be_punctual(plan.priority, set(plan.cores))
    bus = SharedMemoryBus(plan.folder)
    loop = ControlLoop(plan, bus)
    loop.warm_up()
    bus.publish("ready.control", pack_note("ready", refused=refused))
    parent = Lifeline(plan.parent)
    epoch = wait_for_take_off(bus, parent)
    if epoch is None:
        return
    schedule = Schedule(epoch, plan.dt)
    while loop.mode != Mode.LANDED:
        scheduled = schedule.next()
        sleep_until(scheduled)
        woke = time.monotonic()
        while not loop.new_sample() and time.monotonic() < scheduled + PATIENCE:
            time.sleep(2e-4)
        loop.late_samples += time.monotonic() - woke > 2e-4
        loop.tick(time.monotonic(), woke - scheduled)
        if parent.gone():
            loop.land("the supervisor is gone")
        loop.idle()
        loop.missed += schedule.done(time.monotonic(), loop.sample)
    loop.report()
    time.sleep(2 * plan.dt)  # the last command is taken
