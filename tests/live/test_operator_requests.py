"""Requests of an operator in flight are executed once and reported."""

import dataclasses
import time

import jax
import numpy as np
import pytest
from jax import random

from helpers import tiny_preset
from live_helpers import TOPICS
from retrim.adapt.updates import PolicyUpdate
from retrim.config.scenario import Scenario
from retrim.config.setup import Setup
from retrim.control.lora import LoraPolicy
from retrim.io.policies import load_learner_state
from retrim.learn.bptt import PolicyState
from retrim.live.operator import requests as request_module
from retrim.live.operator.manual_disturbance import ManualDisturbance
from retrim.live.operator.requests import OperatorRequests
from retrim.live.processes.published_updates import keep
from retrim.live.session import LiveRequest, live_spec
from retrim.live.status import Status
from retrim.live.supervisor import Supervisor
from retrim.onboard.messages import pack_note
from retrim.transport.in_process import InProcessBus

pytestmark = pytest.mark.usefixtures("optax_promotion")


class RecordingSupervisor(Supervisor):
    """A supervisor without processes, which records its calls."""

    def __init__(self, spec):
        super().__init__(spec)
        room = {f"update.{layer}.{i}": 5_000_000 for layer in ("residual", "policy") for i in (0, 1)}
        self.bus, self.start = InProcessBus(TOPICS | room | {"wish": 4096, "knobs": 4096}), spec.start
        self.messages = []

    def land(self):
        self.messages.append("land")

    def learn(self, *, pause, active):
        self.messages.append((pause, active))

    def learn_from(self, start):
        self.messages.append(start)
        self.start = start


@pytest.fixture
def requests(tmp_path):
    with jax.numpy_dtype_promotion("standard"):
        setup = Setup.from_preset(tiny_preset())
        policy = setup.new_policy(random.key(0))
        request = LiveRequest(setup, policy, Scenario(), "full", 10.0, 0, 3.0, tmp_path)
        return OperatorRequests(request, RecordingSupervisor(live_spec(request)))


def status(**control):
    return Status(1.0, control, {}, {}, {}, None, [], False, 0, None)


def send_wish(requests, **fields):
    requests._supervisor.bus.publish("wish", pack_note("wish", **fields))
    return [f"{event.kind}: {event.note}" for event in requests.obey(status())]


def test_landing_request_lands_vehicle(requests):
    assert send_wish(requests, land=True) == ["request: land"]
    assert requests._supervisor.messages == ["land"]
    assert requests.obey(status()) == []


def test_pause_keeps_learned_parameters_and_none_removes_them(requests):
    assert send_wish(requests, method="full", paused=False) == []
    assert send_wish(requests, method="full", paused=True) == ["request: method full, paused"]
    assert send_wish(requests, method="none", paused=False) == ["request: method none"]
    assert send_wish(requests, method="full", paused=False) == ["request: method full"]
    assert requests._supervisor.messages == [(True, True), (True, False), (False, True)]
    assert send_wish(requests, method="magic") == ["refused: method 'magic': there are full, lora, none"]
    assert send_wish(requests, method=1, land=True) == []
    assert send_wish(requests, method="full", paused="yes") == []
    assert "land" not in requests._supervisor.messages


def test_other_method_continues_from_active_policy(requests):
    supervisor = requests._supervisor
    state = load_learner_state(supervisor.start)[0]
    nudge = state.policy.policy.with_params(jax.tree.map(lambda leaf: leaf + 0.01, state.policy.policy.params))
    keep(supervisor.bus, "policy", 3, PolicyUpdate(1.0, 1.0, 2.0, PolicyState(nudge, state.policy.optimiser)), {})
    flying = status(newest={"policy": 3}, given_up=[])
    supervisor.bus.publish("wish", pack_note("wish", method="lora", paused=False))
    assert [event.note for event in requests.obey(flying)] == ["method lora"]
    until = time.monotonic() + 60.0
    while len(supervisor.messages) < 2 and time.monotonic() < until:
        requests.obey(flying)
        time.sleep(0.01)
    assert supervisor.messages == [(False, True), supervisor.start]
    result = load_learner_state(supervisor.start)[0].policy.policy
    assert isinstance(result, LoraPolicy)
    for leaf, expected in zip(jax.tree.leaves(result.merged().params), jax.tree.leaves(nudge.params), strict=True):
        np.testing.assert_allclose(leaf, expected, atol=1e-12)


def test_settled_knobs_give_one_event(requests, monkeypatch):
    monkeypatch.setattr(request_module, "KNOB_REST_S", 0.0)
    requests._supervisor.bus.publish("knobs", b"noise")
    assert requests.obey(status()) == []
    requests._supervisor.bus.publish("knobs", ManualDisturbance(load=0.05, push=(1.0, 0.0, 0.0)).pack())
    assert [event[1:] for event in requests.obey(status())] == [("knobs", "push 1 0 0 m/s², load 0.05 kg")]
    assert requests.obey(status()) == []


def test_knobs_event_states_change_and_time(requests, monkeypatch):
    def turn(**knobs):
        requests._supervisor.bus.publish("knobs", ManualDisturbance(**knobs).pack())
        monkeypatch.setattr(request_module, "KNOB_REST_S", 60.0)
        assert requests.obey(dataclasses.replace(status(), t=3.0)) == []
        monkeypatch.setattr(request_module, "KNOB_REST_S", 0.0)
        return [tuple(event) for event in requests.obey(dataclasses.replace(status(), t=3.5))]

    push, kick = {"push": (1.0, 0.0, 0.0)}, {"kick": (8.0, 0.0, 0.0), "kicks": 1}
    assert turn(**push) == [(3.0, "knobs", "push 1 0 0 m/s²")]
    assert turn(**push) == []
    assert turn(**push, rotor=0.8) == [(3.0, "knobs", "rotor 0.8")]
    assert turn(**push, rotor=0.8, **kick) == [(3.0, "knobs", "kick 8 0 0 m/s²")]
    assert turn(**kick) == [(3.0, "knobs", "all added effects removed")]
    assert turn(kick=kick["kick"], kicks=2) == [(3.0, "knobs", "kick 8 0 0 m/s²")]
