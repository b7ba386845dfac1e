"""Learners during a live flight: they read windows, publish parameters, and continue from the active policy."""

import equinox as eqx
import jax
import numpy as np
import pytest
from jax import random

from helpers import tiny_preset
from live_helpers import DT, TOPICS
from retrim.adapt.updates import PolicyUpdate, Rejection, pack_update, unpack_update
from retrim.config.setup import Setup
from retrim.io.policies import save_learner_state
from retrim.learn.bptt import PolicyState
from retrim.live.processes.controllers import adaptive_source
from retrim.live.processes.learner import LearnerLoop, LearnerPlan
from retrim.live.processes.published_updates import active_update, keep
from retrim.onboard.messages import COLUMNS, COMMAND, MEASURED, FlightRows, Parameters, pack_note
from retrim.onboard.topics import slot
from retrim.transport.in_process import InProcessBus

pytestmark = pytest.mark.usefixtures("optax_promotion")


@pytest.fixture(scope="module")
def start(tmp_path_factory):
    """Return the file of a learner state, the controller of the flight, and the state."""
    with jax.numpy_dtype_promotion("standard"):
        preset = tiny_preset()
        setup = Setup.from_preset(preset)
        state = setup.learner.init(setup.new_policy(random.key(0)), random.key(1))
        path = tmp_path_factory.mktemp("learner") / "start.safetensors"
        save_learner_state(path, state, preset)
        return path, adaptive_source(setup, state), state


class LearnerRig:
    """Learner loops of some layers on one bus, and rows of a vehicle that hovers under a push without moving."""

    def __init__(self, start, *layers):
        self.path, self.controller, self.state = start
        room = {f"update.{layer}.{i}": 5_000_000 for layer in ("residual", "policy") for i in (0, 1)}
        room |= {"said.residual": 8192, "said.policy": 8192, "parameters.residual": 2_000_000}
        room |= {"ready.residual": 8192, "ready.policy": 8192}
        self.bus = InProcessBus(TOPICS | room)
        self.tick, self.now = 0, 100.0
        self.loops = {layer: self.learner(layer) for layer in layers}

    def learner(self, layer):
        plan = LearnerPlan(self.path.parent, layer, self.path, None, 3, self.controller.base, 0)
        return LearnerLoop(plan, self.bus, lambda: self.now)

    def fly(self, ticks=60):
        self.tick += ticks
        self.now += 100.0
        rows = np.zeros((ticks, len(COLUMNS)))
        rows[:, 0] = np.arange(self.tick - ticks, self.tick)
        rows[:, 1] = DT * rows[:, 0]
        rows[:, MEASURED] = np.concatenate([[0.0, 0.0, 1.0], np.eye(3).ravel(), np.zeros(3)])
        rows[:, COMMAND] = np.array([10.3, 0.0, 0.0, 0.0]) + 0.01 * np.sin(rows[:, :1])
        self.bus.publish("flight", FlightRows(rows).pack())

    def report_status(self, newest, given_up=(), mode="policy"):
        note = pack_note("status", newest={"policy": newest}, given_up=list(given_up), mode=mode)
        self.bus.publish("status", note)

    def parameters(self, half, after=0):
        message = self.bus.latest(f"parameters.{half}")
        expected, base = self.controller.parameters[half], self.controller.base
        return Parameters.unpack(message.data, expected, half=half, base=base, after=after)

    def update(self, layer, version):
        data = self.bus.latest(slot(layer, version)).data
        assert int.from_bytes(data[:8], "little") == version
        return unpack_update(data[8:], self.state, source=layer)


def stub_learning(loop, meanwhile=lambda: None):
    """Replace the training of a loop: each update shifts the last policy a little, without delay."""

    def learn(window):
        meanwhile()
        before = loop.worker._policy
        nudge = jax.tree.map(lambda leaf: leaf + 0.01, before.policy.params)
        state = PolicyState(before.policy.with_params(nudge), before.optimiser)
        return PolicyUpdate(float(window.t[-1]), 1.0, 2.0, state)

    loop.worker.learn = learn
    return loop


def weights(tree):
    return np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(eqx.filter(tree, eqx.is_array))])


def starting_weights(loop):
    """Return the weights from which the next update starts."""
    return weights(loop.worker._policy.policy)


def test_learner_publishes_parameters_from_window(start):
    rig = LearnerRig(start, "residual")
    loop = rig.loops["residual"]
    assert not loop.step()
    rig.fly()
    assert loop.step()
    result = rig.parameters("residual")
    assert (result.version, result.parent, result.computed_from) == (1, 0, pytest.approx(59 * DT))
    assert not loop.step()  # there are no new rows
    rig.fly()
    rig.now -= 99.99
    assert not loop.step()  # the interval has not ended
    rig.now += 99.99
    assert loop.step()
    assert rig.parameters("residual", after=1).version == 2


def test_versions_continue_from_active_policy_on_new_bus(start):
    rig = LearnerRig(start, "policy")
    loop = stub_learning(rig.loops["policy"])
    rig.report_status(57)
    rig.fly()
    assert loop.step()
    assert rig.parameters("policy").version == 58


def test_update_during_pause_is_not_published(start):
    rig = LearnerRig(start, "policy")
    note = pack_note("learning", paused=True)
    loop = stub_learning(rig.loops["policy"], lambda: rig.bus.publish("learning", note))
    rig.fly()
    loop.step()
    assert rig.bus.latest("parameters.policy") is None


def test_paused_or_descending_flight_starts_no_update(start):
    rig = LearnerRig(start, "residual")
    loop = rig.loops["residual"]
    rig.fly()
    rig.bus.publish("learning", pack_note("learning", paused=True))
    assert not loop.step()
    rig.bus.publish("learning", pack_note("learning", paused=False))
    rig.report_status(0, mode="descend")
    assert not loop.step()
    rig.report_status(0)
    assert loop.step()


def test_policy_update_starts_from_active_policy(start):
    rig = LearnerRig(start, "policy")
    loop = stub_learning(rig.loops["policy"])
    rig.fly()
    assert loop.step()
    first = rig.update("policy", 1)
    assert isinstance(first, PolicyUpdate)
    rig.fly()
    rig.report_status(newest=1)
    assert loop.step()
    np.testing.assert_array_equal(starting_weights(loop), weights(first.state.policy))
    assert rig.parameters("policy", after=1).parent == 1
    # After a rollback of the second policy, the next update starts from the first one again.
    rig.report_status(newest=2)
    loop.step()
    np.testing.assert_array_equal(starting_weights(loop), weights(rig.update("policy", 2).state.policy))
    rig.fly()
    rig.report_status(newest=2, given_up=[2])
    assert loop.step()
    np.testing.assert_array_equal(starting_weights(loop), weights(first.state.policy))
    assert rig.parameters("policy", after=2).parent == 1


def test_update_does_not_start_from_rolled_back_policy(start):
    rig = LearnerRig(start, "policy")
    loop = stub_learning(rig.loops["policy"])
    rig.fly()
    assert loop.step()
    rig.fly()
    rig.report_status(newest=1, given_up=[1])
    assert loop.step()
    np.testing.assert_array_equal(starting_weights(loop), weights(rig.state.policy.policy))


def test_update_of_policy_rolled_back_during_training_is_discarded(start):
    rig = LearnerRig(start, "policy")
    loop = stub_learning(rig.loops["policy"])
    rig.fly()
    assert loop.step()
    rig.fly()
    rig.report_status(newest=1)
    stub_learning(loop, lambda: rig.report_status(newest=1, given_up=[1]))
    assert loop.step()
    assert rig.bus.latest("parameters.policy").version == 1
    np.testing.assert_array_equal(starting_weights(loop), weights(rig.state.policy.policy))


def test_learner_waits_for_report_about_slow_update(start):
    rig = LearnerRig(start, "policy")
    loop = stub_learning(rig.loops["policy"])

    def take_seconds():
        rig.now += 5.0

    stub_learning(loop, take_seconds)
    rig.fly()
    rig.report_status(newest=0)
    assert loop.step()
    rig.now += 0.1
    assert not loop.step()
    rig.report_status(newest=1)
    loop.step()
    np.testing.assert_array_equal(starting_weights(loop), weights(rig.update("policy", 1).state.policy))


def test_learner_stops_waiting_for_unused_policy(start):
    rig = LearnerRig(start, "policy")
    loop = stub_learning(rig.loops["policy"])
    rig.fly()
    assert loop.step()
    rig.fly()
    rig.report_status(newest=0)
    assert loop.step()
    np.testing.assert_array_equal(starting_weights(loop), weights(rig.state.policy.policy))


def test_restarted_learner_continues_from_active_parameters(start):
    rig = LearnerRig(start, "residual", "policy")
    rig.fly()
    stub_learning(rig.loops["policy"])
    for loop in rig.loops.values():
        assert loop.step()
    rig.bus.publish("said.policy", pack_update(Rejection(1.0, "policy", "worse")))
    rig.report_status(newest=0)
    earlier = rig.learner("policy")
    earlier.catch_up()
    np.testing.assert_array_equal(starting_weights(earlier), weights(rig.state.policy.policy))
    rig.report_status(newest=1)
    later = rig.learner("policy")
    later.catch_up()
    np.testing.assert_array_equal(weights(later.worker._residual), weights(rig.update("residual", 1).state))
    np.testing.assert_array_equal(starting_weights(later), weights(rig.update("policy", 1).state.policy))
    rig.fly()
    assert stub_learning(later).step()
    assert rig.parameters("policy", after=1).parent == 1


@pytest.mark.parametrize("given_up", [[], [5]])
def test_active_update_remains_on_bus_despite_unused_updates(start, given_up):
    """A controller that hangs accepts no further updates."""
    rig = LearnerRig(start)
    update = PolicyUpdate(0.0, 0.0, 0.0, rig.state.policy)
    for version in range(1, 10):
        newest = min(version - 1, 5)
        keep(rig.bus, "policy", version, update, {"newest": {"policy": newest}, "given_up": given_up * (version > 5)})
    result, _ = active_update(rig.bus, rig.state, "policy", {"newest": {"policy": 5}, "given_up": given_up})
    assert result == (4 if given_up else 5)
