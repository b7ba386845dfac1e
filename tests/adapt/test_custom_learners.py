"""A user's online learners, workers, optimisers and learning methods, in single flights, batches and fleets."""

import dataclasses

import equinox as eqx
import jax
import numpy as np
import optax
import pytest
from jax import random

from helpers import BRIEF, tiny_preset
from retrim.adapt import AbstractPolicyOptimiser, OnlineLearner, Rejection, Worker
from retrim.adapt.batched_workers import learn_together
from retrim.config import Scenario, Setup, changed, learning_method, register_learner, register_method
from retrim.config.methods import METHODS, learning_methods
from retrim.config.online_learners import LEARNERS, OPTIMISERS, register_optimiser
from retrim.errors import ConfigError
from retrim.learn import PolicyState
from retrim.runtime import fly
from retrim.runtime.batched_learning import Plan
from retrim.runtime.together import can_fly_together

TICKS = 70


class Doubling(OnlineLearner):
    """A learner that adds a number to each weight instead of training."""

    amount: float = 1e-4

    def retrain(self, state, env, starts, key):
        params = jax.tree.map(lambda leaf: leaf + self.amount, state.policy.params)
        return PolicyState(state.policy.with_params(params), state.optimiser)


class Refuses(Worker):
    layer = "policy"

    def __init__(self):
        self.windows, self.updates = 0, []

    def learn(self, window):
        self.windows += 1
        return Rejection(float(window.t[-1]), "policy", f"window {self.windows}")

    def receive(self, update):
        self.updates.append(update)


class WithWorker(OnlineLearner):
    def worker(self, layer, state, key):
        return Refuses() if layer == "policy" else None


class Sgd(AbstractPolicyOptimiser):
    rate: jax.Array
    max_grad_norm: jax.Array

    def transformation(self, num_updates):
        return optax.sgd(self.rate)

    def begin(self, state, num_updates):
        return state


@pytest.fixture(scope="module", autouse=True)
def names():
    register_learner("doubling", lambda request: request.create(Doubling))
    register_learner("refusing", lambda request: request.create(WithWorker))
    register_learner("nothing", lambda request: 3)
    register_optimiser("sgd", Sgd)
    register_method("mine", learning_method("mine", lambda setup, policy, key: policy))
    yield
    for name in ("doubling", "refusing", "nothing"):
        del LEARNERS._objects[name]
    del OPTIMISERS._objects["sgd"], METHODS._objects["mine"]


def setup_of(**adapt):
    return Setup.from_preset(changed(tiny_preset(), adapt={**BRIEF["adapt"], **adapt}))


@pytest.mark.usefixtures("as_a_user")
def test_custom_learner_replaces_only_training():
    setup = setup_of(learner="doubling")
    policy = setup.new_policy(random.key(0))
    pilots = [setup.pilot(policy, "mine", random.key(1)) for _ in range(2)]
    log = fly(Scenario("large").make(), pilots[0], setup.flight_starts(1)[0], ticks=TICKS)
    updates = [event for event in log.events if event.kind in ("policy", "rejected")]
    assert updates
    assert any(event.kind == "residual" for event in log.events)
    trained_policy = pilots[0].state.policy.policy
    accepted_command = sum(event.kind == "policy" for event in updates)
    for new, old in zip(jax.tree.leaves(trained_policy.params), jax.tree.leaves(policy.params), strict=True):
        np.testing.assert_allclose(new, old + accepted_command * Doubling.amount, atol=1e-6)
    assert Plan.of(pilots[1]) is not None  # batches use the same functions


@pytest.mark.usefixtures("as_a_user")
def test_custom_worker_in_single_flight_and_fleet():
    setup = setup_of(learner="refusing")
    pilot = setup.pilot(setup.new_policy(random.key(0)), "full", random.key(1))
    plant, start = Scenario("large").make(), setup.flight_starts(1)[0]
    assert not can_fly_together([plant], [pilot])
    log = fly(plant, pilot, start, ticks=TICKS)
    worker = pilot.learners[1].learner.worker
    notes = [event.note for event in log.events if event.kind == "rejected"]
    assert notes == [f"window {i + 1}" for i in range(len(notes))]
    assert len(notes) >= 1
    assert worker.updates
    window = pilot._buffer.window()
    updates = learn_together([Refuses(), Refuses()], [window, window])
    assert [type(update) for update in updates] == [Rejection, Rejection]


@pytest.mark.usefixtures("as_a_user")
def test_custom_optimiser_trains_policy():
    setup = setup_of(optimiser="sgd", learning_rate=1e-5)
    assert isinstance(setup.learner.optimiser, Sgd)
    policy = setup.new_policy(random.key(0))
    pilot = setup.pilot(policy, "full", random.key(1))
    fly(Scenario("large").make(), pilot, setup.flight_starts(1)[0], ticks=TICKS)
    kinds = {event.kind for event in pilot.events}
    assert kinds & {"policy", "rejected"}


def test_custom_method_is_a_learning_method():
    assert learning_methods()[:2] == ("full", "lora")
    assert "mine" in learning_methods()
    assert METHODS["base"].learns is None


def test_unsuitable_names_are_refused():
    with pytest.raises(ConfigError, match="no learner 'bttp'; did you mean 'bptt'"):
        setup_of(learner="bttp")
    with pytest.raises(ConfigError, match="no optimiser 'frish'; did you mean 'fresh'"):
        setup_of(optimiser="frish")
    with pytest.raises(ConfigError, match="learner 'math:pi' is a float, not a function of a LearnerRequest"):
        setup_of(learner="math:pi")
    with pytest.raises(ConfigError, match="optimiser 'math:pi' is a float, not an AbstractPolicyOptimiser"):
        setup_of(optimiser="math:pi")
    with pytest.raises(ConfigError, match=r"learner 'nothing' returns int, expected a retrim\.OnlineLearner"):
        setup_of(learner="nothing")


def test_subclass_receives_settings_of_preset():
    learner = setup_of(learner="doubling", num_updates=7).learner
    assert isinstance(learner, Doubling)
    assert learner.num_updates == 7
    plain = setup_of(num_updates=7).learner
    for field in dataclasses.fields(OnlineLearner):
        assert eqx.tree_equal(getattr(learner, field.name), getattr(plain, field.name)), field.name
