"""The adaptive loop: updates of any learner in order, and the virtual clock that adds compute time to the flight."""

import dataclasses
import math
import types
from collections import deque

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import random

from helpers import tiny_preset
from odd_plant import OddPlant
from retrim.adapt import PolicyUpdate, Rejection, ResidualUpdate, ResidualWorker, Skip
from retrim.config import Setup, changed
from retrim.physics import Command
from retrim.runtime import AdaptivePilot, Learner, LockstepLearner, ScheduledLearner, fly, lockstep

pytestmark = pytest.mark.usefixtures("optax_promotion")

BRISK = {"fit_every": 0.6, "update_every": 1.0, "fit_latency": 0.1, "update_latency": 0.3}
TRACES = []
"""One entry for each time that a program of the learner is traced."""


@pytest.fixture(scope="module")
def trained_policy():
    """Return a setup whose learner counts its traces, and a trained policy."""
    with jax.numpy_dtype_promotion("standard"):
        setup = Setup.from_preset(tiny_preset(adapt=BRISK))
        learner = eqx.tree_at(lambda l: l.env.task, setup.learner, count(setup.env.task))
        return dataclasses.replace(setup, learner=learner), setup.pretrained(1)


@pytest.fixture(scope="module")
def sample_flight(trained_policy):
    """Return 3.2 s of a flight with learning, and its pilot."""
    with jax.numpy_dtype_promotion("standard"):
        return flight(*trained_policy, 3.2)


def count(task):
    class CountingTask(type(task)):
        def reward(self, t, x, u):
            TRACES.append(1)
            return super().reward(t, x, u)

    return CountingTask(**{f.name: getattr(task, f.name) for f in dataclasses.fields(task)})


def reschedule(setup, **adapt):
    return dataclasses.replace(setup, preset=changed(setup.preset, adapt=adapt))


def flight(setup, policy, seconds, plant=None, **options):
    pilot = setup.adaptive_pilot(policy, random.key(3), **options)
    log = fly(plant or OddPlant("large"), pilot, setup.flight_starts(1)[0], ticks=round(seconds / setup.preset.dt))
    return log, pilot


def plain_flight(setup, policy, seconds):
    return fly(
        OddPlant("large"), setup.pilot(policy), setup.flight_starts(1)[0], ticks=round(seconds / setup.preset.dt)
    )


def times(log, *kinds):
    return [event.t for event in log.events if event.kind in kinds]


# ---- any learner


class QueueLearner(Learner):
    """A learner that answers from a queue, like one in a different process: the test determines when an update is
    visible.
    """

    def __init__(self, answers=()):
        self._answers = deque(answers)  # (tick, update)
        self.windows, self.updates, self.resets = [], [], 0

    def submit(self, window, tick):
        self.windows.append((tick, window))

    def poll(self, tick):
        result = []
        while self._answers and self._answers[0][0] <= tick:
            result.append(self._answers.popleft()[1])
        return result

    def receive(self, update):
        self.updates.append(update)

    def reset(self):
        self.resets += 1


def queue_pilot(setup, policy, *learners, every_s=0.1, window=12):
    state = setup.learner.init(policy, random.key(2))
    schedule = tuple(ScheduledLearner(learner, every_s) for learner in learners)
    return AdaptivePilot(setup.controller, state, schedule, dt=setup.preset.dt, window=window)


def bias(state, by):
    """Return the same policy with a shifted output."""
    return eqx.tree_at(lambda s: s.policy.layers[-1].bias, state, state.policy.layers[-1].bias + by)


def test_updates_are_applied_in_order_and_sent_to_all_learners(trained_policy):
    setup, policy = trained_policy
    state = setup.learner.init(policy, random.key(2))
    fit_result = jax.tree.map(lambda leaf: leaf + 1, state.residual)
    first, second = bias(state.policy, 0.1), bias(state.policy, 0.2)
    updates = [
        ResidualUpdate(0.1, 0.3, fit_result),
        PolicyUpdate(0.1, 0.1, 0.2, first),
        Rejection(0.1, "residual", "why not"),
        PolicyUpdate(0.1, 0.1, 0.2, second),
        Skip(0.3, "policy"),
    ]
    one = QueueLearner([(8, updates[0]), (8, updates[1]), (8, updates[2]), (15, updates[4])])
    other = QueueLearner([(8, updates[3])])
    pilot = queue_pilot(setup, policy, one, other)
    log = fly(OddPlant("large"), pilot, setup.flight_starts(1)[0], ticks=20)
    assert [id(u) for u in one.updates] == [id(u) for u in updates]
    assert [id(u) for u in other.updates] == [id(u) for u in updates]
    assert [e.kind for e in log.events] == ["residual", "policy", "rejected", "policy", "skipped"]
    np.testing.assert_allclose([e.t for e in log.events], [0.16, 0.16, 0.16, 0.16, 0.3])
    assert pilot.state.policy is second
    assert pilot.state.residual is fit_result
    # An update that is published at a tick is active from that tick on.
    plain = plain_flight(setup, policy, 0.4)
    np.testing.assert_array_equal(log.u[:9], plain.u[:9])
    assert not np.array_equal(log.u[9], plain.u[9])
    controller = setup.pilot(second.policy)
    with OddPlant("large") as plant:
        measurement = plant.reset(setup.flight_starts(1)[0])
        controller.reset(measurement)
        for k in range(9):
            u = controller.act(measurement)
            if k < 8:
                controller.accept(Command.of(jnp.asarray(log.u[k + 1])))
                measurement, _ = plant.step(Command.of(jnp.asarray(log.u[k + 1])))
    np.testing.assert_allclose(u.vector(), log.u[9], rtol=1e-12)


def test_learners_receive_windows_on_schedule_and_are_reset(trained_policy):
    setup, policy = trained_policy
    one, other = QueueLearner(), QueueLearner()
    pilot = queue_pilot(setup, policy, one, other)
    for flights in (1, 2):
        log = fly(OddPlant("large", clock=37.0 * flights), pilot, setup.flight_starts(1)[0], ticks=18)
        assert (one.resets, other.resets) == (flights, flights)
        assert [tick for tick, _ in one.windows] == [5, 10, 15] * flights
        tick, window = one.windows[-2]
        assert int(window.valid.sum()) == tick + 1  # no data of an earlier flight
        np.testing.assert_allclose(window.t[np.asarray(window.valid)], 0.02 * np.arange(11), atol=1e-9)
        tick, window = other.windows[-1]
        expected = log.window(12, end=16)
        for a, b in zip(jax.tree.leaves(window), jax.tree.leaves(expected), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-12)


def test_immediate_answer_is_published_in_same_tick(trained_policy):
    """A skip is also published in the same tick."""
    setup, policy = trained_policy

    class BusyLearner(QueueLearner):
        def submit(self, window, tick):
            super().submit(window, tick)
            self._answers.append((tick, Skip(float(window.t[-1]), "policy")))

    log = fly(OddPlant("large"), queue_pilot(setup, policy, BusyLearner()), setup.flight_starts(1)[0], ticks=12)
    np.testing.assert_allclose(times(log, "skipped"), [0.1, 0.2])


def test_pilot_without_learners_flies_policy(trained_policy):
    setup, policy = trained_policy
    log = fly(OddPlant("large"), queue_pilot(setup, policy), setup.flight_starts(1)[0], ticks=20)
    np.testing.assert_array_equal(log.u, plain_flight(setup, policy, 0.4).u)
    assert log.events == ()


def test_windows_have_measured_states_and_accepted_commands(trained_policy):
    """The learner's window equals that of the log, with noisy sensors and a plant that limits commands."""
    setup, policy = trained_policy
    learner = QueueLearner()
    limit = lambda u: Command(jnp.clip(u.c, 9.6, 9.9), jnp.clip(u.omega, -0.05, 0.05))  # noqa: E731
    plant = OddPlant("large", limit=limit, sensors="rough")
    log = fly(plant, queue_pilot(setup, policy, learner), setup.flight_starts(1)[0], ticks=16)
    tick, window = learner.windows[-1]
    expected = log.window(12, end=tick + 1)
    np.testing.assert_array_equal(window.x.p, expected.x.p)
    np.testing.assert_array_equal(window.x.v, log.measured.v[4:16])
    assert not np.allclose(window.x.p, log.p[4:16], atol=1e-6)
    # The last command was issued and is not accepted yet; no fit uses it.
    np.testing.assert_array_equal(window.u.c[:-1], expected.u.c[:-1])
    np.testing.assert_array_equal(window.u.omega[:-1], log.u[5:16, 1:])
    assert float(window.u.c.max()) <= 9.9 or float(window.u.c[-1]) > 9.9


# ---- on the virtual clock


def test_lockstep_repeats_bit_for_bit(trained_policy, sample_flight):
    first, one = sample_flight
    second, two = flight(*trained_policy, 3.2)
    for name in ("t", "u"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))
    jax.tree.map(np.testing.assert_array_equal, (first.true, first.measured), (second.true, second.measured))
    assert first.events == second.events == tuple(one.events)
    assert {"residual"} < {e.kind for e in first.events}
    jax.tree.map(np.testing.assert_array_equal, one.state, two.state)


def test_updates_appear_after_their_latency(sample_flight):
    """Residuals are due every 0.6 s and take 0.1 s; policies are due every 1 s and take 0.3 s."""
    log, _ = sample_flight
    np.testing.assert_allclose(times(log, "residual"), [0.7, 1.3, 1.9, 2.5, 3.1], atol=1e-9)
    np.testing.assert_allclose(times(log, "policy", "rejected"), [1.3, 2.3], atol=1e-9)


def test_commands_are_those_of_old_policy_until_swap(trained_policy, sample_flight):
    """The flight equals an unadapted one up to the tick at which the first policy appears, and differs afterwards."""
    log, _ = sample_flight
    plain = plain_flight(*trained_policy, 3.2)
    swap = round(times(log, "policy")[0] / 0.02)
    np.testing.assert_array_equal(log.u[: swap + 1], plain.u[: swap + 1])
    assert not np.array_equal(log.u[swap + 1], plain.u[swap + 1])


def test_flight_is_independent_of_clock_origin(trained_policy, sample_flight):
    here, _ = sample_flight
    there, _ = flight(*trained_policy, 3.2, OddPlant("large", clock=1.7e9))
    assert there.t[0] == 0.0
    np.testing.assert_allclose(there.t, here.t, atol=1e-6)
    np.testing.assert_array_equal(there.u, here.u)
    assert [(e.kind, e.note) for e in there.events] == [(e.kind, e.note) for e in here.events]
    np.testing.assert_allclose([e.t for e in there.events], [e.t for e in here.events], atol=1e-6)
    assert len(here.events) >= 4


def test_busy_learner_is_skipped(trained_policy):
    setup, policy = trained_policy
    busy = reschedule(setup, fit_every=10.0, update_every=0.5, update_latency=0.7)
    log, _ = flight(busy, policy, 2.5)
    np.testing.assert_allclose(times(log, "skipped"), [1.0, 2.0])


def test_measured_latency_equals_clock(trained_policy, monkeypatch):
    """Each reading of the clock is 0.17 s after the last one."""
    setup, policy = trained_policy
    now = iter(0.17 * np.arange(1000))
    monkeypatch.setattr(lockstep, "time", types.SimpleNamespace(perf_counter=lambda: float(next(now))))
    log, _ = flight(setup, policy, 1.5, latency="measured")
    np.testing.assert_allclose(times(log, "residual"), [0.78, 1.38])
    np.testing.assert_allclose(times(log, "policy", "rejected"), [1.18])


def test_many_cycles_need_one_compilation(trained_policy):
    """New weights, optimiser states, windows and keys need no new compilation."""
    setup, policy = trained_policy
    pilot = setup.adaptive_pilot(policy, random.key(3))
    fly(OddPlant("large"), pilot, setup.flight_starts(1)[0], ticks=60)
    program = len(TRACES)
    assert program > 0
    log = fly(OddPlant("large"), pilot, setup.flight_starts(1)[0], ticks=250)
    assert len(times(log, "policy", "rejected")) >= 4
    assert len(TRACES) == program


def with_learning_rate(setup, rate):
    """Return the same setup with updates of this learning rate."""
    return dataclasses.replace(setup, learner=eqx.tree_at(lambda l: l.optimiser.rate, setup.learner, jnp.array(rate)))


def test_adaptation_reduces_error_under_large_disturbance(trained_policy):
    """The complete loop at reduced size has at most a third of the error of the base policy."""
    setup, _ = trained_policy
    policy = Setup.from_preset(changed(setup.preset, pretrain={"num_updates": 300, "learning_rate": 0.01})).pretrained(
        0
    )
    often = reschedule(with_learning_rate(setup, 3e-3), fit_every=0.4, update_every=0.4, update_latency=0.2)
    base = plain_flight(setup, policy, 8.0)
    adapted_policy, _ = flight(often, policy, 8.0)
    before, after = (np.linalg.norm(log.p[-50:] - setup.preset.goal, axis=1).mean() for log in (base, adapted_policy))
    assert after < before / 3


def test_refused_policy_is_logged_and_not_used(trained_policy):
    """The learning rate is NaN, so that every update fails."""
    setup, policy = trained_policy
    log, pilot = flight(with_learning_rate(setup, math.nan), policy, 3.0)
    np.testing.assert_array_equal(log.u, plain_flight(setup, policy, 3.0).u)
    refusal = [e for e in log.events if e.kind == "rejected"]
    np.testing.assert_allclose([e.t for e in refusal], [1.3, 2.3])
    assert {e.note for e in refusal} == {"a weight is not finite"}
    jax.tree.map(np.testing.assert_array_equal, pilot.state.policy.policy, policy)


def test_second_flight_keeps_learner_state_and_clears_window(trained_policy):
    setup, policy = trained_policy
    log, pilot = flight(setup, policy, 1.5)
    learner_state = pilot.state
    assert times(log, "policy", "residual")
    again = fly(OddPlant("large"), pilot, setup.flight_starts(1)[0], ticks=10)
    assert again.events == ()
    jax.tree.map(np.testing.assert_array_equal, pilot.state, learner_state)
    # The adapted policy is active from the first tick on.
    fresh = fly(OddPlant("large"), setup.pilot(learner_state.policy.policy), setup.flight_starts(1)[0], ticks=10)
    np.testing.assert_array_equal(again.u, fresh.u)


def test_flight_continues_from_learner_state(trained_policy):
    setup, policy = trained_policy
    _, pilot = flight(setup, policy, 1.5)
    resumed_pilot = setup.adaptive_pilot(policy, random.key(3), state=pilot.state)
    jax.tree.map(np.testing.assert_array_equal, resumed_pilot.state, pilot.state)
    log = fly(OddPlant("large"), resumed_pilot, setup.flight_starts(1)[0], ticks=10)
    fresh = fly(OddPlant("large"), setup.pilot(pilot.state.policy.policy), setup.flight_starts(1)[0], ticks=10)
    np.testing.assert_array_equal(log.u, fresh.u)


class RecordingWorker(ResidualWorker):
    """A residual worker that stores its updates."""

    def __init__(self, *args):
        super().__init__(*args)
        self.updates = []

    def learn(self, window):
        self.updates.append(super().learn(window))
        return self.updates[-1]


def test_missed_ticks_keep_schedule_and_do_not_bias_fit(trained_policy):
    """The clock jumps by three ticks at every ninth step, while the plant is pushed by 2 m/s^2 per axis."""
    setup, policy = trained_policy

    def fits(stalls):
        state = setup.learner.init(policy, random.key(2))
        worker = RecordingWorker(setup.learner, state)
        learner = LockstepLearner(worker, 0.1, 0.02)
        pilot = AdaptivePilot(setup.controller, state, [ScheduledLearner(learner, 0.6)], dt=0.02, window=100)
        log = fly(OddPlant("large", stalls=stalls), pilot, setup.flight_starts(1)[0], ticks=160)
        assert log.missed_ticks == 2 * sum(s < len(log.t) - 1 for s in stalls)
        return log, [update.rms_error for update in worker.updates]

    smooth, calm = fits(())
    rough, errors = fits(tuple(range(4, 160, 9)))
    assert smooth.missed_ticks == 0
    assert rough.missed_ticks > 20
    assert rough.t[-1] == pytest.approx(3.2, abs=0.05)
    due = 0.6 * np.arange(1, 6)
    assert len(times(rough, "residual")) == len(times(smooth, "residual")) == 5
    late = np.array(times(rough, "residual")) - due
    assert np.all((late > 0.099) & (late < 0.1 + 0.1))  # the first available tick after the latency
    assert max(errors[1:]) < 2.0 * max(calm[1:])
