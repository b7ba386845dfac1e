"""Change of the reference in flight: request, transition of the vehicle, and learning on the new reference."""

import dataclasses
import time
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import random

from helpers import brief_preset
from live_helpers import TOPICS, plan
from live_processes import DT, level, move
from retrim.config.scenario import Scenario
from retrim.config.setup import Setup
from retrim.io.policies import save_learner_state
from retrim.live.live_options import choices, paths
from retrim.live.operator import reference_switcher as switcher_module
from retrim.live.operator.reference_switcher import ReferenceSwitcher
from retrim.live.processes.controllers import adaptive_source
from retrim.live.processes.learner import LearnerLoop, LearnerPlan
from retrim.live.session import LiveRequest, live_spec
from retrim.live.status import Status
from retrim.live.supervisor import Supervisor
from retrim.onboard.control import ControlLoop
from retrim.onboard.messages import COLUMNS, FlightRows, Parameters, Sample, last_note, unpack_note
from retrim.onboard.topics import REFERENCE
from retrim.physics import State
from retrim.tasks.shapes import circle, figure8
from retrim.tasks.transition import splice, transition_between
from retrim.transport import wire
from retrim.transport.in_process import InProcessBus

pytestmark = pytest.mark.usefixtures("optax_promotion")
ROOM = TOPICS | {"parameters.reference": 400_000, "followed": 4096, "wish": 4096}
ROOM |= {f"update.residual.{i}": 5_000_000 for i in (0, 1)}
AT = 1.4  # [s]


@pytest.fixture(scope="module")
def setups():
    """Return a set-up on the circle, its initial learner state, and the controller."""
    with jax.numpy_dtype_promotion("standard"):
        setup = Setup.from_preset(brief_preset("track/retrim"), "circle")
        state = setup.learner.init(setup.new_policy(random.key(0)), random.key(1))
        return setup, state, adaptive_source(setup, state)


@pytest.fixture(scope="module")
def table(setups):
    return transition_between(setups[0].flight_reference, figure8(), AT, setups[0].vehicle)


def message(table, controller, version=1, computed_from=AT - 0.8):
    arrays = {name: np.asarray(leaf) for name, leaf in wire.names(table).items()}
    return Parameters(REFERENCE, version, controller.base, computed_from, arrays).pack()


class Flight:
    """The control loop on a point mass without delay and without a clock."""

    def __init__(self, controller):
        self.bus = InProcessBus(ROOM)
        self.loop = ControlLoop(plan(controller, delay_ticks=0), self.bus)
        self.x, self.tick, self.commands = level(np.array([0.0, 0.0, 1.0])), 0, []

    def fly_until(self, t):
        while self.tick * DT < t - 1e-9:
            now, u = time.monotonic(), self.commands[-1] if self.commands else np.array([9.81, 0.0, 0.0, 0.0])
            self.bus.publish("sample", Sample(self.tick, self.tick * DT, now, 0.0, self.x, self.x, u).pack())
            self.commands.append(self.loop.tick(now).u)
            self.loop.idle()
            self.x = move(self.x, self.commands[-1])
            self.tick += 1

    @property
    def status(self):
        self.loop.report()
        return unpack_note(self.bus.latest("status").data, "status")


# ---- control


def test_reference_is_parameter_of_controller(setups, table):
    plain, other = Flight(setups[2]), Flight(setups[2])
    for flight in (plain, other):
        flight.fly_until(0.7)
    other.bus.publish("parameters.reference", message(table, setups[2]))
    for flight in (plain, other):
        flight.fly_until(0.96)  # the preview of 0.4 s still shows the old reference
    np.testing.assert_allclose(plain.commands, other.commands, atol=0.02)
    for t in (0.9, 2.0, 3.3, 20.0):
        np.testing.assert_allclose(other.loop.pilot.target(t), table(jnp.array(t)).p, atol=1e-9)
        np.testing.assert_allclose(plain.loop.pilot.target(t), setups[0].flight_task.target(jnp.array(t)), atol=1e-9)
    assert other.status["versions"] == {"policy": 0, "residual": 0, REFERENCE: 1}
    assert other.status["swaps"] == []  # no policy was learned


def test_reference_remains_with_learning_on_and_off(setups, table):
    flight = Flight(setups[2])
    flight.fly_until(0.7)
    flight.loop.intake.open = False
    flight.bus.publish("parameters.reference", message(table, setups[2]))
    flight.fly_until(0.8)
    expected = np.asarray(table(jnp.array(9.0)).p)
    for learning in (False, True, False):
        flight.loop.intake.open = learning
        np.testing.assert_allclose(flight.loop.pilot.target(9.0), expected, atol=1e-9)
        assert flight.status["versions"][REFERENCE] == 1


def test_late_reference_is_refused(setups, table):
    flight = Flight(setups[2])
    flight.fly_until(AT)
    flight.bus.publish("parameters.reference", message(table, setups[2]))
    flight.fly_until(AT + 0.1)
    assert flight.status["refused"] == {"late reference": 1}
    np.testing.assert_allclose(flight.loop.pilot.target(9.0), setups[0].flight_task.target(jnp.array(9.0)), atol=1e-9)


# ---- the learner


def test_learner_uses_new_reference_without_compiling_again(setups, table, tmp_path):
    setup, state, controller = setups
    start = tmp_path / "start.safetensors"
    save_learner_state(start, state, setup.preset)
    bus = InProcessBus(ROOM)
    loop = LearnerLoop(LearnerPlan(tmp_path, "policy", start, "circle", 3, controller.base, 0), bus)
    before = loop.worker.learner
    bus.publish("parameters.reference", message(table, controller)[:-1] + b"x")  # a damaged message
    loop.due()
    assert loop.worker.learner is before
    bus.publish("parameters.reference", message(table, controller))
    loop.due()
    after = loop.worker.learner
    t = jnp.array(9.0)
    np.testing.assert_allclose(after.env.task.target(t), table(t).p, atol=1e-9)
    np.testing.assert_allclose(after.env.task.observation.reference(t).p, table(t).p, atol=1e-9)
    assert jax.tree.structure(after) == jax.tree.structure(before)
    for leaf, other in zip(jax.tree.leaves(after), jax.tree.leaves(before), strict=True):
        if isinstance(leaf, jax.Array):
            assert (leaf.aval, leaf.weak_type) == (other.aval, other.weak_type)


# ---- the switcher


class RecordingSupervisor(Supervisor):
    """A supervisor with a bus and without processes; the time of the plant is ``behind`` the wall clock [s]."""

    def __init__(self, spec, behind):
        super().__init__(spec)
        self.bus, self.epoch, self._behind = InProcessBus(ROOM), time.monotonic() - 10.0, behind
        self.fly()

    def fly(self):
        t = time.monotonic() - self.epoch - self._behind
        self.bus.publish("flight", FlightRows(np.eye(1, len(COLUMNS), COLUMNS.index("t")) * t).pack())
        return t


def make_switcher(setups, folder, fence=3.0, behind=0.0):
    setup, state, _ = setups
    request = LiveRequest(setup, state.policy.policy, Scenario(reference="circle"), "full", 60.0, 0, fence, folder)
    supervisor = RecordingSupervisor(live_spec(request), behind)
    return ReferenceSwitcher(request, supervisor, ThreadPoolExecutor(1)), supervisor


def status(supervisor, version=0):
    supervisor.fly()
    t = time.monotonic() - supervisor.epoch
    return Status(t, {"versions": {REFERENCE: version}}, {}, {}, {}, None, [], False, 0, None)


def poll_requests(switcher, supervisor, done, version=0):
    """Process requests until ``done``; return the events."""
    events, until = [], time.monotonic() + 60.0
    while not done() and time.monotonic() < until:
        events += [f"{event.kind}: {event.note}" for event in switcher.obey(status(supervisor, version))]
        time.sleep(0.005)
    return events


def test_choice_is_sent_as_table_and_followed_once_accepted(setups, tmp_path):
    switcher, supervisor = make_switcher(setups, tmp_path)
    assert switcher.ask("circle", 1.0) == []  # this reference is active already
    assert switcher.ask("module:name", 1.0) == []  # the switcher does not offer it
    assert [event.note for event in switcher.ask("figure8", 1.0)] == ["reference figure8"]
    assert switcher.ask("star", 1.0) == []  # one change at a time; the request is repeated below
    bus = supervisor.bus
    assert poll_requests(switcher, supervisor, lambda: bus.latest("parameters.reference") is not None) == []
    assert len(switcher.pieces) == 1
    controller = supervisor.spec.controller
    result = Parameters.unpack(
        bus.latest("parameters.reference").data, controller.parameters[REFERENCE], half=REFERENCE, base=controller.base,
        after=0,
    )  # fmt: skip
    assert result.computed_from <= time.monotonic() - supervisor.epoch
    assert poll_requests(switcher, supervisor, lambda: len(switcher.pieces) > 1, 1) == [
        "reference: transition tofigure8", "request: reference star",
    ]  # fmt: skip
    assert switcher.name == last_note(bus, "followed")["name"] == "figure8"
    at, table = switcher.pieces[-1]
    t = at + 12.0
    expected = figure8()(jnp.array(12.0)).p
    np.testing.assert_allclose(table(jnp.array(t)).p, expected, atol=1e-3)

    whole = setups[0].on(splice(switcher.pieces))  # errors are relative to this reference
    x = State.at(expected)
    assert float(whole.flight_task.error(jnp.array(t), x)) < 1e-3
    assert float(whole.flight_task.error(jnp.array(5.0), State.at(circle()(jnp.array(5.0)).p))) < 1e-9


def test_late_plant_changes_reference_at_plant_time(setups, tmp_path):
    """A table refers to the time of the plant; with the time of the wall clock, it would begin too late."""
    switcher, supervisor = make_switcher(setups, tmp_path, behind=5.0)
    switcher.ask("figure8", 10.0)
    began = supervisor.fly()
    bus = supervisor.bus
    poll_requests(switcher, supervisor, lambda: bus.latest("parameters.reference") is not None)
    controller = supervisor.spec.controller
    data = bus.latest("parameters.reference").data
    result = Parameters.unpack(data, controller.parameters[REFERENCE], half=REFERENCE, base=controller.base, after=0)
    assert began <= result.computed_from <= supervisor.fly()
    assert switcher.obey(status(supervisor)) == []
    assert switcher._attempts == 1
    poll_requests(switcher, supervisor, lambda: len(switcher.pieces) > 1, 1)
    assert switcher.pieces[-1][0] == pytest.approx(result.computed_from + switcher_module.LEAD)


def test_reference_outside_fence_or_not_accepted_is_reported(setups, tmp_path, monkeypatch):
    switcher, supervisor = make_switcher(setups, tmp_path, fence=0.5)
    switcher.ask("figure8", 1.0)
    (message,) = poll_requests(switcher, supervisor, lambda: switcher._coming is None)
    assert "reference figure8 cannot be followed: it passes" in message
    assert "--fence" in message
    assert supervisor.bus.latest("parameters.reference") is None
    assert switcher.ask("figure8", 2.0) == []  # the page repeats its request

    monkeypatch.setattr(switcher_module, "LEAD", 0.05)
    switcher.ask("star", 2.0)
    events = poll_requests(
        switcher, supervisor, lambda: switcher._attempts == 3 and switcher._coming is switcher._pending is None
    )
    assert events == ["request: reference star cannot be followed: it was not taken"]
    assert switcher.name == "circle"
    last, controller = supervisor.bus.latest("parameters.reference").data, supervisor.spec.controller
    back = Parameters.unpack(last, controller.parameters[REFERENCE], half=REFERENCE, base=controller.base, after=3)
    np.testing.assert_array_equal(
        back.arrays["rows"], setups[0].flight_reference.rows
    )  # learners return to the reference of the flight


def test_only_policies_that_observe_reference_have_choices(setups):
    assert choices(setups[0], "circle") == ("circle", "figure8", "lissajous", "star")
    assert choices(setups[0], "my.csv") == ("my.csv", "circle", "figure8", "lissajous", "star")
    assert choices(Setup.from_preset("track/blind"), "figure8") == ()
    assert choices(Setup.from_preset("track/paper"), "figure8") == ("figure8", "circle", "lissajous", "star")
    assert choices(Setup.from_preset("hover/retrim"), "") == ()
    shapes = paths(("circle", "star"), 20.0)
    np.testing.assert_allclose(shapes["circle"][-1], circle()(jnp.array(19.95)).p, atol=1e-9)
    assert shapes["star"].shape == (400, 3)


def test_setup_on_other_reference_differs_only_in_reference(setups, table):
    other = setups[0].on(table)
    assert other.flight_reference is table
    assert other.env is setups[0].env
    assert (
        dataclasses.replace(other, flight_task=setups[0].flight_task, learner=setups[0].learner).preset
        == setups[0].preset
    )
    back = other.on(setups[0].flight_reference)
    jax.tree.map(
        np.testing.assert_array_equal, jax.tree.leaves(back.flight_task), jax.tree.leaves(setups[0].flight_task)
    )
