"""The virtual clock: a result appears after its latency in whole ticks, and one window at a time is in progress."""

import types

import jax.numpy as jnp
import pytest

from retrim.adapt import Rejection, RollingBuffer, Skip, Worker
from retrim.physics import Command, State
from retrim.runtime import LockstepLearner, lockstep


class RefusingWorker(Worker):
    """A worker that refuses each window immediately."""

    layer = "policy"

    def __init__(self):
        self.updates, self.count = [], 0

    def learn(self, window):
        self.count += 1
        return Rejection(float(window.t[-1]), self.layer, f"window {self.count}")

    def receive(self, update):
        self.updates.append(update)


def window(t):
    buffer = RollingBuffer(2)
    buffer.push(t, State.at(jnp.zeros(3)), Command.hover())
    return buffer.window()


def tick_of_update(learner, tick):
    """Return the tick at which the update of a window from ``tick`` appears."""
    learner.submit(window(0.02 * tick), tick)
    for later in range(tick, tick + 100):
        if learner.poll(later):
            return later
    return None


@pytest.mark.parametrize(("latency_s", "ticks"), [(0.001, 1), (0.02, 1), (0.021, 2), (0.1, 5), (0.3, 15), (1.0, 50)])
def test_latencies_are_rounded_up_to_whole_ticks(latency_s, ticks):
    assert tick_of_update(LockstepLearner(RefusingWorker(), latency_s, 0.02), 7) == 7 + ticks


def test_latency_in_ticks_is_proportional_to_rate():
    assert tick_of_update(LockstepLearner(RefusingWorker(), 0.2, 0.01), 0) == 20


def test_measured_latency_equals_clock(monkeypatch):
    """The worker takes 0.37 s."""
    readings = iter([100.0, 100.37, 200.0, 200.05])
    monkeypatch.setattr(lockstep, "time", types.SimpleNamespace(perf_counter=lambda: next(readings)))
    learner = LockstepLearner(RefusingWorker(), None, 0.02)
    assert tick_of_update(learner, 0) == 19
    assert tick_of_update(learner, 50) == 53


def test_window_is_skipped_while_learner_is_busy():
    worker = RefusingWorker()
    learner = LockstepLearner(worker, 0.1, 0.02)
    learner.submit(window(1.0), 50)
    learner.submit(window(1.04), 52)
    assert worker.count == 1
    assert learner.poll(52) == [Skip(1.04, "policy")]
    assert learner.poll(54) == []
    assert learner.poll(55) == [Rejection(1.0, "policy", "window 1")]
    assert learner.poll(56) == []


def test_reset_discards_window_in_progress():
    worker = RefusingWorker()
    learner = LockstepLearner(worker, 0.1, 0.02)
    learner.submit(window(1.0), 50)
    learner.submit(window(1.02), 51)
    learner.reset()
    assert learner.poll(1000) == []
    learner.submit(window(0.0), 0)
    assert worker.count == 2


def test_worker_receives_published_updates():
    worker = RefusingWorker()
    update = Skip(1.0, "residual")
    LockstepLearner(worker, 0.1, 0.02).receive(update)
    assert worker.updates == [update]
