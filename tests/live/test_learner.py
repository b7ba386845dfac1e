"""A learner beside the flight: windows in, parameters out; it goes on from what is flown, not from what it wished."""

import equinox as eqx
import jax
import numpy as np
import pytest
from jax import random

from helpers import tiny_preset
from live_helpers import DT, TOPICS
from retrim.adapt.updates import PolicyUpdate, unpack_update
from retrim.config.setup import Setup
from retrim.io.trained import save_learnt
from retrim.live.controllers import adaptive_source
from retrim.live.learner_process import LearnerLoop, LearnerPlan
from retrim.onboard.messages import COLUMNS, COMMAND, MEASURED, FlightRows, Parameters, pack_note
from retrim.transport.in_process import InProcessBus

pytestmark = pytest.mark.usefixtures("optax_promotion")


@pytest.fixture(scope="module")
def start(tmp_path_factory):
    """A file with what was learnt before the flight, and the controller that flies."""
    with jax.numpy_dtype_promotion("standard"):
        preset = tiny_preset()
        setup = Setup.of(preset)
        state = setup.learner.init(setup.new_policy(random.key(0)), random.key(1))
        path = tmp_path_factory.mktemp("learner") / "start.safetensors"
        save_learnt(path, state, preset)
        return path, adaptive_source(setup, state), state


class Beside:
    """A loop of each layer on one bus; rows of a vehicle that hovers under a push that it does not feel."""

    def __init__(self, start, *layers):
        self.path, self.controller, self.state = start
        room = {"update.residual": 5_000_000, "update.policy": 5_000_000, "parameters.residual": 2_000_000}
        self.bus = InProcessBus(TOPICS | room)
        self.loops = {layer: self.learner(layer) for layer in layers}
        self.tick, self.now = 0, 100.0

    def learner(self, layer):
        return LearnerLoop(
            LearnerPlan(self.path.parent, layer, self.path, None, 3, self.controller.base, frozenset({0}), 0), self.bus
        )

    def fly(self, ticks=60):
        self.tick += ticks
        self.now += ticks * DT
        rows = np.zeros((ticks, len(COLUMNS)))
        rows[:, 0] = np.arange(self.tick - ticks, self.tick)
        rows[:, 1] = DT * rows[:, 0]
        rows[:, MEASURED] = np.concatenate([[0.0, 0.0, 1.0], np.eye(3).ravel(), np.zeros(3)])
        rows[:, COMMAND] = np.array([10.3, 0.0, 0.0, 0.0]) + 0.01 * np.sin(rows[:, :1])
        self.bus.publish("flight", FlightRows(rows).pack())

    def says(self, **status):
        self.bus.publish("status", pack_note("status", **status))

    def parameters(self, half, after=0):
        message = self.bus.latest(f"parameters.{half}")
        expected, base = self.controller.parameters[half], self.controller.base
        return Parameters.unpack(message.data, expected, half=half, base=base, after=after)

    def update(self, layer):
        return unpack_update(self.bus.latest(f"update.{layer}").data, self.state, source=layer)


def weights(tree):
    return np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(eqx.filter(tree, eqx.is_array))])


def test_a_window_becomes_parameters_that_the_controller_takes(start):
    beside = Beside(start, "residual")
    loop = beside.loops["residual"]
    assert not loop.step(beside.now)
    beside.fly()
    assert loop.step(beside.now)
    found = beside.parameters("residual")
    assert (found.version, found.computed_from) == (1, pytest.approx(59 * DT))
    assert not loop.step(beside.now)  # nothing new, and not time
    beside.fly()
    beside.now += 10.0
    assert loop.step(beside.now)
    assert beside.parameters("residual", after=1).version == 2


def test_a_policy_goes_on_from_what_is_flown(start):
    beside = Beside(start, "policy")
    loop = beside.loops["policy"]
    beside.fly()
    assert loop.step(beside.now)
    first = beside.update("policy")
    assert isinstance(first, PolicyUpdate), first
    beside.fly()
    beside.now += 100.0
    beside.says(versions={"policy": 1}, rolled_back=[0])
    assert loop.step(beside.now)
    np.testing.assert_array_equal(weights(loop._flown[-1][1].state.policy), weights(first.state.policy))
    # The second one was taken back: the next starts from the first again.
    beside.says(versions={"policy": 2}, rolled_back=[0])
    loop.step(beside.now)
    beside.says(versions={"policy": 1}, rolled_back=[0, 2])
    loop.step(beside.now)
    np.testing.assert_array_equal(weights(loop._worker._policy.policy), weights(first.state.policy))


def test_a_policy_that_nobody_flies_is_not_waited_for(start):
    beside = Beside(start, "policy")
    loop = beside.loops["policy"]
    beside.fly()
    assert loop.step(beside.now)
    beside.fly()
    beside.says(versions={"policy": 0}, rolled_back=[0])
    beside.now += 0.5
    assert not loop.step(beside.now)
    beside.now += 100.0
    assert loop.step(beside.now)
    np.testing.assert_array_equal(weights(loop._worker._policy.policy), weights(beside.state.policy.policy))


def test_one_that_was_started_again_goes_on_from_what_was_published(start):
    beside = Beside(start, "residual", "policy")
    beside.fly()
    for loop in beside.loops.values():
        assert loop.step(beside.now)
    again = beside.learner("policy")
    again.catch_up()
    np.testing.assert_array_equal(weights(again._worker._residual), weights(beside.update("residual").state))
    np.testing.assert_array_equal(weights(again._worker._policy.policy), weights(beside.update("policy").state.policy))
    beside.fly()
    beside.says(versions={"policy": 1}, rolled_back=[0])
    beside.now += 100.0
    assert again.step(beside.now)
    assert beside.parameters("policy", after=1).version == 2
