"""A batch of flights with learning equals single flights with their pilots."""

import threading

import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from helpers import CheapModel, tiny_preset
from retrim.adapt.batched_workers import BATCH, IN_CACHE, at_once
from retrim.adapt.updates import Rejection, Skip
from retrim.adapt.worker import Worker
from retrim.config import Setup, disturbance
from retrim.learn import Window
from retrim.physics import Command
from retrim.plants import SensorModel, SimPlant
from retrim.runtime import ControllerPilot, FlightStopped, FunctionPilot, LockstepLearner, fly
from retrim.runtime.batched_learning import offers
from retrim.runtime.together import can_fly_together, fly_together

TICKS = 70


class CountingWorker(Worker):
    """A worker that learns nothing."""

    layer = "policy"

    def learn(self, window):
        return Rejection(0.0, "policy", "learns nothing")

    def receive(self, update):
        pass


STILL = Window.of(np.zeros(1), np.zeros((1, 3)), np.eye(3)[None], np.zeros((1, 3)), np.full(1, 9.81), np.zeros((1, 3)))


@given(period=st.integers(1, 12), latency=st.integers(1, 30))
def test_offers_equal_those_of_virtual_clock(period, latency):
    learner, message = LockstepLearner(CountingWorker(), 0.02 * latency, 0.02), []
    for tick in range(60):
        message += [(tick, type(update)) for update in learner.poll(tick)]
        if tick and tick % period == 0:
            learner.submit(STILL, tick)
            message += [(tick, type(update)) for update in learner.poll(tick)]
    expected = []
    for offer in offers(period, latency, 60):
        expected.append((offer.tick, Skip) if offer.visible is None else (offer.visible, Rejection))
    assert sorted(message, key=str) == sorted((each for each in expected if each[0] < 60), key=str)


@given(n=st.integers(1, 400), size=st.integers(1, 2 * IN_CACHE))
def test_rounds_have_limited_size_and_little_padding(n, size):
    few = at_once(n, size)
    assert 1 <= few <= BATCH
    assert few == 1 or few * size <= IN_CACHE
    assert -n % few <= n % 2
    assert few > 1 or n == 1 or 2 * size > IN_CACHE


@pytest.fixture(scope="module")
def sample_flight(as_a_user):
    """Return five flights that train a delta, with noisy sensors; every other offer finds the learner busy.

    Three learn at the same time, so that the last round has an empty slot.
    """
    soon = {"window": 20, "fit_every": 0.2, "update_every": 0.3, "fit_latency": 0.1, "update_latency": 0.38}
    preset = tiny_preset(adapt=soon)
    setup = Setup.from_preset(preset)
    policies = [setup.new_policy(jax.random.key(seed)) for seed in (0, 0, 5, 0, 0)]
    starts = setup.flight_starts(5)
    sensors = SensorModel.of(position=1e-3, velocity=3e-3, attitude=1e-3, latency=10)

    def parts():
        pilots = [setup.pilot(policy, "lora", jax.random.key(i)) for i, policy in enumerate(policies)]
        push = disturbance("small")
        return [SimPlant(CheapModel(0.02), push, sensors=sensors, seed=i) for i in range(5)], pilots

    plants, pilots = parts()
    assert can_fly_together(plants, pilots)
    message = []
    logs = fly_together(plants, pilots, starts, ticks=TICKS, progress=message.append, cold=True)
    others, alone = parts()
    each = [fly(plant, pilot, x0, ticks=TICKS) for plant, pilot, x0 in zip(others, alone, starts, strict=True)]
    return logs, pilots, each, alone, message, setup


def test_states_commands_and_times_are_equal(sample_flight):
    logs, _, each, _, message, _ = sample_flight
    for log, other in zip(logs, each, strict=True):
        np.testing.assert_array_equal(log.t, other.t)
        for states, others in ((log.true, other.true), (log.measured, other.measured)):
            for a, b in zip(states, others, strict=True):
                np.testing.assert_allclose(a, b, atol=2e-4)
        np.testing.assert_allclose(log.u, other.u, atol=2e-3)
        assert not log.terminated
    assert message[-1] == 1.0
    assert message == sorted(message)


def test_events_are_equal(sample_flight):
    logs, _, each, _, _, _ = sample_flight
    for log, other in zip(logs, each, strict=True):
        assert [(e.t, e.kind) for e in log.events] == [(e.t, e.kind) for e in other.events]
    kinds = {event.kind for log in logs for event in log.events}
    assert {"residual", "skipped"} <= kinds
    assert kinds & {"policy", "rejected"}


def test_learner_states_are_equal(sample_flight):
    """The outputs are compared: by rounding, Adam moves a weight with a tiny gradient in either direction."""
    _, pilots, _, alone, _, setup = sample_flight
    inputs = np.random.default_rng(0).normal(size=(50, 23)).astype(np.float32)
    start, model = setup.flight_starts(1)[0], setup.learner.residual_model

    @jax.jit
    def outputs(state):
        return jax.vmap(state.policy.policy.merged())(inputs), model.predict(state.residual, start, Command.hover())

    for pilot, other in zip(pilots, alone, strict=True):
        (a, specific_force), (b, expected) = outputs(pilot.state), outputs(other.state)
        np.testing.assert_allclose(a.c, b.c, atol=0.03)
        np.testing.assert_allclose(a.omega, b.omega, atol=0.03)
        np.testing.assert_allclose(specific_force, expected, atol=0.05)


def test_pilot_continues_with_its_learner_state(sample_flight):
    """Its learners continue from there with the next random numbers."""
    _, pilots, _, alone, _, setup = sample_flight
    for pilot, other in zip(pilots, alone, strict=True):
        mine, theirs = (jax.random.key_data(each.learners[1].learner.worker.key) for each in (pilot, other))
        np.testing.assert_array_equal(mine, theirs)
    pilot, start = pilots[0], setup.flight_starts(1)[0]
    plain = [SimPlant(CheapModel(0.02), disturbance("none")) for _ in range(2)]
    log = fly(plain[0], pilot, start, ticks=3)
    learner_state = fly(plain[1], ControllerPilot(pilot.controller_of(pilot.state)), start, ticks=3)
    np.testing.assert_array_equal(log.u, learner_state.u)
    for schedule in pilot.learners:
        worker = schedule.learner.worker
        jax.tree.map(np.testing.assert_array_equal, worker._residual, pilot.state.residual)
        if hasattr(worker, "_policy"):
            jax.tree.map(np.testing.assert_array_equal, worker._policy, pilot.state.policy)


def test_flights_that_cannot_share_a_program_are_reported(as_a_user):
    setup = Setup.from_preset(tiny_preset())
    policy = setup.new_policy(jax.random.key(0))
    calm, windy = ([SimPlant(CheapModel(0.02), disturbance(name), seed=i) for i in (0, 1)] for name in ("none", "wind"))
    base = [setup.pilot(policy) for _ in range(2)]
    learning = [setup.pilot(policy, "full", jax.random.key(i)) for i in range(2)]
    assert can_fly_together(calm, base)
    assert can_fly_together(windy, learning)
    assert not can_fly_together([calm[0], windy[0]], base)
    assert not can_fly_together(calm, [base[0], learning[0]])
    assert not can_fly_together(calm, [base[0], setup.pilot(policy, "base-i")])
    by_the_clock = [setup.pilot(policy, "full", jax.random.key(i), latency="measured") for i in range(2)]
    assert not can_fly_together(calm, by_the_clock)
    assert not can_fly_together(calm, [FunctionPilot(lambda m: None)] * 2)
    stop = threading.Event()
    stop.set()
    with pytest.raises(FlightStopped):
        fly_together(calm, base, setup.flight_starts(2), ticks=5, stop=stop)
