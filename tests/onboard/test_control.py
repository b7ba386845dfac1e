"""The control loop without a clock equals the lockstep flight, tick for tick, and rejects wrong messages."""

import dataclasses
import time

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from jax import random

from helpers import CheapModel
from live_helpers import TOPICS, HoverController, hover_source, plan, setup
from live_processes import DT, HOME, level, move
from retrim import PlantError
from retrim.adapt.learner_state import LearnerState
from retrim.live.processes.controllers import adaptive_source, plain_source
from retrim.onboard.control import ControlLoop
from retrim.onboard.guard import Mode
from retrim.onboard.messages import (
    COLUMNS,
    COMMAND,
    TRUE,
    FlightRows,
    Parameters,
    Sample,
    Setpoint,
    Stamp,
    pack_note,
    unpack_note,
)
from retrim.onboard.tick_budget import PHASE, SHARE
from retrim.onboard.timing_stats import has_measurement
from retrim.physics import Command, State
from retrim.physics.disturbance import Constant
from retrim.plants.sim import SimPlant
from retrim.runtime import ControllerPilot, fly
from retrim.transport.in_process import InProcessBus


class Flight:
    """A control loop on a point mass with a delay of one tick, without a clock."""

    def __init__(self, source, *, push=(0.0, 0.0, 0.0), x=None, **options):
        self.bus = InProcessBus(TOPICS)
        self.loop = ControlLoop(plan(source, **options), self.bus)
        self.x, self.push, self.tick = level() if x is None else x, push, 0
        self.acting = self.accepted = np.array([9.81, 0.0, 0.0, 0.0])
        self.commands = []

    def measurement(self, now):
        return Sample(self.tick, self.tick * DT, now, 0.0, self.x, self.x, self.accepted)

    def step(self, ticks=1, *, late=0.0, change=lambda sample: sample):
        for _ in range(ticks):
            now = time.monotonic()
            self.bus.publish("sample", change(self.measurement(now - late)).pack())
            setpoint = self.loop.tick(now)
            self.loop.idle()
            self.commands.append(setpoint.u)
            self.x = move(self.x, self.acting, self.push)
            self.acting = self.accepted = setpoint.u
            self.tick += 1
        return self.commands[-1]

    def parameters(self, gains, version, base=None, *, half="policy", parent=0):
        arrays = {"gains": np.array(gains)} if half == "policy" else {"fit": np.array(gains)}
        base = self.loop.plan.controller.base if base is None else base
        return Parameters(half, version, base, self.tick * DT, arrays, parent).pack()

    @property
    def status(self):
        self.loop.report()
        return unpack_note(self.bus.latest("status").data, "status")


def test_equals_lockstep_flight_tick_for_tick():
    """The flight includes the frame, the observer and regression, on a plant with a delay, under a push."""
    result = setup()
    state = result.learner.init(result.new_policy(random.key(0)), random.key(1))
    push = Constant(jnp.array([0.3, -0.2, 0.4]))
    x0 = State.at(jnp.array([0.2, -0.1, 1.1]))
    log = fly(SimPlant(CheapModel(), push), ControllerPilot(result.controller(state)), x0, ticks=60)

    bus = InProcessBus(TOPICS)
    loop = ControlLoop(plan(adaptive_source(result, state), window=100), bus)
    loop.warm_up()
    with SimPlant(CheapModel(), push) as plant:
        measurement, accepted_command = plant.reset(x0), np.array([9.81, 0.0, 0.0, 0.0])
        for tick in range(60):
            x = np.concatenate([np.asarray(leaf).ravel() for leaf in (measurement.p, measurement.R, measurement.v)])
            now = time.monotonic()
            loop.rehearse()  # the rehearsal has no effect on it
            bus.publish("sample", Sample(tick, measurement.t, now, 0.0, x, x, accepted_command).pack())
            u = loop.tick(now).u
            measurement, extract = plant.step(Command(jnp.asarray(u[0]), jnp.asarray(u[1:])))
            accepted_command = np.asarray(extract.vector())
    loop.idle()
    rows = FlightRows.unpack(bus.latest("flight").data).rows
    # A tick is reported when the next measurement contains the accepted command.
    np.testing.assert_allclose(rows[:, 3:6], log.p[:-2], atol=1e-9)
    np.testing.assert_allclose(rows[:, COMMAND], log.u[1:-1], atol=1e-9)
    np.testing.assert_allclose(rows[:, 1], log.t[:-2], atol=1e-12)


@pytest.mark.parametrize("slow", [False, True])
def test_only_fast_controller_is_rehearsed(monkeypatch, slow):
    flight = Flight(hover_source())
    act, rehearsals = flight.loop.pilot.act, []
    monkeypatch.setattr(flight.loop.pilot, "act", lambda *argument: (time.sleep(0.1 * DT * slow), act(*argument))[1])
    monkeypatch.setattr(flight.loop.pilot, "rehearse", lambda *argument: rehearsals.append(argument))
    flight.loop.warm_up()
    flight.loop.rehearse()
    assert not rehearsals  # no measurement yet
    flight.step()
    flight.loop.rehearse()
    assert bool(rehearsals) != slow
    flight.step(late=1.0)  # the guard has control
    rehearsals.clear()
    flight.loop.rehearse()
    assert not rehearsals


def test_swap_blends_commands():
    flight = Flight(hover_source(), x=level(x=0.4))
    flight.step(3)
    before = flight.commands[-1]
    flight.bus.publish("parameters.policy", flight.parameters((1.0, 1.0), 1))
    flight.loop.idle()
    result = [flight.step() for _ in range(8)]
    assert flight.status["versions"] == {"policy": 1}
    whole = np.abs(result[-1] - before).max()
    jumps = np.abs(np.diff([before, *result], axis=0)).max(1)
    assert jumps.max() < 0.45 * whole
    # After the blend, the command is that of the new controller.
    fresh = Flight(hover_source((1.0, 1.0)), x=flight.x)
    np.testing.assert_allclose(flight.step(), fresh.step(), atol=1e-12)


def test_invalid_messages_are_refused_counted_and_reported():
    flight = Flight(hover_source())
    flight.step(2)
    good = flight.parameters((3.0, 3.0), 5)
    flight.bus.publish("parameters.policy", good)
    flight.step()
    for bad in (
        flight.parameters((3.0, 3.0), 5),
        flight.parameters((3.0, 3.0), 4),
        flight.parameters((3.0, 3.0), 9, base="of another"),
        flight.parameters((3.0, np.nan), 9),
        flight.parameters((3.0, 3.0, 3.0), 9),
        good[:-5],
    ):
        flight.bus.publish("parameters.policy", bad)
        flight.step()
    assert flight.status["versions"] == {"policy": 5}
    assert flight.status["refused"] == {"stale policy": 2, "policy": 4}
    flight.bus.publish("parameters.policy", flight.parameters((3.0, 3.0), 6))
    flight.step()
    assert flight.status["versions"] == {"policy": 6}


@pytest.mark.parametrize("topic", ["parameters.policy", "sample", "order"])
def test_damaged_messages_and_random_bytes_are_refused(topic):
    rng, flight = np.random.default_rng(7), Flight(hover_source())
    flight.step(3)
    now = time.monotonic()
    whole = {
        "parameters.policy": flight.parameters((-9.0, -9.0), 99),
        "sample": Sample(999, 99.0, time.monotonic(), 0.0, level([9.0, 9.0, 9.0]), level(), np.zeros(4)).pack(),
        "order": pack_note("order", order="land"),
    }[topic]
    for i in range(2000):
        if i % 2:
            data = bytearray(whole)
            for _ in range(rng.integers(1, 4)):
                at = rng.integers(len(data))
                data[at] = (data[at] + rng.integers(1, 256)) % 256
            data = data[: rng.integers(len(data))] if i % 4 == 1 else data
        else:
            data = rng.bytes(rng.integers(0, 300))
        if bytes(data) != whole:
            flight.bus.publish(topic, bytes(data))
            flight.loop.idle()
            flight.loop.tick(now)
    assert flight.loop.mode == Mode.POLICY
    assert flight.status["versions"] == {"policy": 0}
    flight.step(5)
    np.testing.assert_allclose(flight.x[:3], HOME, atol=1e-6)


def test_clearly_worse_policy_is_rolled_back():
    flight = Flight(hover_source(), push=(0.3, 0.0, 0.0))
    flight.step(200)
    flight.bus.publish("parameters.policy", flight.parameters((-3.0, -1.0), 1))
    flight.step(120)
    assert flight.status["given_up"] == [1]
    assert flight.loop.mode == Mode.POLICY
    flight.step(400)
    np.testing.assert_allclose(flight.x[:3], HOME + np.array([0.3 / 4.0, 0.0, 0.0]), atol=1e-3)
    # From now on it is stale; a newer one is not.
    flight.bus.publish("parameters.policy", flight.parameters((-3.0, -1.0), 1))
    flight.step()
    assert flight.status["refused"] == {"stale policy": 1}
    assert flight.status["versions"] == {"policy": 0}
    # A policy trained from it is refused; a different one is accepted.
    flight.bus.publish("parameters.policy", flight.parameters((5.0, 4.0), 2, parent=1))
    flight.step()
    assert flight.status["given_up"] == [1, 2]
    flight.bus.publish("parameters.policy", flight.parameters((5.0, 4.0), 3))
    flight.step(10)
    assert flight.status["versions"] == {"policy": 3}


def test_initial_policy_flies_while_learning_is_disabled():
    flight, plain = Flight(hover_source(), x=level(x=0.4)), Flight(hover_source(), x=level(x=0.4))
    flight.bus.publish("parameters.policy", flight.parameters((6.0, 5.0), 1))
    flight.step(100)
    flight.bus.publish("learning", pack_note("learning", paused=True, flown=False))
    flight.step()
    assert flight.status["versions"] == {"policy": 0}
    assert not flight.status["learning"]
    flight.bus.publish("parameters.policy", flight.parameters((7.0, 5.0), 2))
    flight.step(20)
    flight.x = level(x=0.4)
    plain.step(121)
    plain.x = level(x=0.4)
    np.testing.assert_allclose(flight.step(), plain.step(), atol=0.05)
    flight.bus.publish("learning", pack_note("learning", paused=False, flown=True))
    flight.step(2)
    assert flight.status["versions"] == {"policy": 2}
    assert flight.status["refused"] == {}


def test_policy_age_is_that_of_active_policy():
    flight = Flight(hover_source(), push=(0.3, 0.0, 0.0), policy_age=5.0)
    flight.step(200)
    # a new policy, which is soon rolled back
    flight.bus.publish("parameters.policy", flight.parameters((-3.0, -1.0), 1))
    flight.step(120)
    assert flight.status["given_up"] == [1]
    assert flight.loop.mode != Mode.POLICY  # the active policy is as old as the flight
    assert "the policy was learned" in flight.status["reason"]
    late = Flight(hover_source())
    late.step(10)
    message = Parameters("policy", 1, late.loop.plan.controller.base, 1e9, {"gains": np.ones(2)}, 0)
    late.bus.publish("parameters.policy", message.pack())
    late.step(2)
    assert late.status["refused"] == {"policy of a time to come": 1}


def test_rollback_while_fits_and_policies_arrive():
    flight = Flight(hover_source(fit_result=True), push=(0.3, 0.0, 0.0))
    flight.step(200)
    for i in range(1, 120):
        if i % 10 == 1:
            flight.bus.publish("parameters.residual", flight.parameters(0.1 * i, i, half="residual"))
        if i % 25 == 1:
            flight.bus.publish("parameters.policy", flight.parameters((-3.0, -1.0), i, parent=max(0, i - 25)))
        flight.step()
        if flight.status["given_up"]:
            break
    assert flight.status["versions"]["policy"] == 0
    assert flight.status["versions"]["residual"] >= 11
    flight.step(300)
    assert flight.loop.mode == Mode.POLICY
    np.testing.assert_allclose(flight.x[:3], HOME + np.array([0.3 / 4.0, 0.0, 0.0]), atol=1e-3)


def test_second_swap_during_blend_is_continuous():
    flight = Flight(hover_source(), x=level(x=0.4))
    flight.step(3)
    before = flight.commands[-1]
    for version, gains in ((1, (1.0, 1.0)), (2, (1.0, 1.0)), (3, (1.0, 1.0))):
        flight.bus.publish("parameters.policy", flight.parameters(gains, version))
        flight.loop.idle()
        flight.step(2)
    flight.step(8)
    whole = np.abs(flight.commands[-1] - before).max()
    assert np.abs(np.diff(flight.commands[2:], axis=0)).max() < 0.45 * whole


def test_controller_memory_has_clipped_command():
    class RecordsAccepted(HoverController):
        def init(self, x):
            return jnp.zeros_like(x.p)

        def __call__(self, memory, t, x):
            return Command(jnp.full_like(x.p[0], 99.0), jnp.zeros_like(x.p)), jnp.full_like(x.p, 99.0)

        def accept(self, memory, u):
            return jnp.full_like(memory, 1.0) * u.c

    flight = Flight(plain_source(setup(), RecordsAccepted()))
    flight.step()
    assert flight.commands[-1][0] == 30.0
    np.testing.assert_array_equal(flight.loop.pilot._memory[0], 30.0)


def test_policy_does_not_resume_after_silence():
    flight = Flight(hover_source())
    flight.step(20)
    flight.tick += 10
    flight.step(1)
    assert flight.loop.mode == Mode.HOLD
    assert flight.status["missed"] == 10
    assert flight.status["reason"] == "10 measurements were not answered"


def test_missed_tick_is_counted_without_row():
    flight = Flight(hover_source(), x=level(x=0.4))
    flight.step(10)
    flight.tick += 2
    flight.accepted = flight.accepted + np.eye(4)[0]
    flight.step(3)
    rows = FlightRows.unpack(flight.bus.latest("flight").data).rows
    assert flight.status["missed"] == 2
    np.testing.assert_array_equal(rows[:, 0], [*range(10), 12, 13])
    np.testing.assert_allclose(rows[9, COMMAND], flight.commands[9], atol=1e-12)
    flight.loop.land("landing")
    flight.tick += 2
    flight.step()
    assert flight.status["missed"] == 2  # the landing does not count


def test_lands_after_time_limit():
    flight = Flight(hover_source(), seconds=1.0)
    flight.step(52)
    assert flight.loop.mode != Mode.POLICY
    assert flight.status["reason"] == "landing"


def test_disturbance_after_swap_causes_no_rollback():
    flight = Flight(hover_source())
    flight.step(100)
    flight.bus.publish("parameters.policy", flight.parameters((3.9, 3.4), 1))
    flight.step(5)
    flight.push = (3.0, 0.0, 0.0)
    flight.step(150)
    assert np.linalg.norm(flight.x[:3] - HOME) > 0.5
    assert flight.status["given_up"] == []


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda s: dataclasses.replace(s, state=level(np.array([3.2, 0.0, 1.0]))), "geofence"),
        (lambda s: dataclasses.replace(s, state=np.concatenate([s.state[:12], [0.0, 20.0, 0.0]])), "speed"),
    ],
)
def test_exceeded_limit_activates_fallback_and_lands(change, reason):
    flight = Flight(hover_source())
    flight.step(20)
    flight.step(1, change=change)
    assert flight.loop.mode == Mode.HOLD
    assert flight.status["reason"].startswith(reason)
    flight.step(400)
    assert flight.loop.mode == Mode.LANDED
    assert np.isfinite(flight.commands).all()
    assert flight.x[2] < 0.2


def test_nonfinite_command_is_not_issued():
    source = hover_source()
    flight = Flight(dataclasses.replace(source, parameters={"policy": {"gains": np.array([np.nan, 3.5])}}))
    flight.step(30)
    assert np.isfinite(flight.commands).all()
    assert flight.status["reason"] == "the policy's command is not finite"


def test_nonfinite_target_is_replaced_by_last_target(monkeypatch):
    flight = Flight(hover_source())
    flight.step(20)
    monkeypatch.setattr(flight.loop.pilot, "target", lambda t: np.array([0.0, np.nan, 1.0]))
    flight.x = level(x=0.4)
    for _ in range(60):
        flight.step()
        text = Setpoint.unpack(flight.bus.latest("setpoint").data)
        assert text.tick == flight.tick - 1
        np.testing.assert_array_equal(text.target, HOME)
    assert flight.loop.mode == Mode.HOLD
    assert flight.status["reason"] == "the target is not finite"
    assert np.linalg.norm(flight.x[:3] - HOME) < 0.2


def test_holds_position_without_target(monkeypatch):
    flight = Flight(hover_source(), x=level(x=0.4))
    monkeypatch.setattr(flight.loop.pilot, "target", lambda t: np.full(3, np.inf))
    flight.step(50)
    np.testing.assert_array_equal(Setpoint.unpack(flight.bus.latest("setpoint").data).target, level(x=0.4)[:3])
    np.testing.assert_allclose(flight.x[:3], level(x=0.4)[:3], atol=1e-6)


def test_refused_measurement_leads_to_level_descent():
    flight = Flight(hover_source(), x=level(x=0.4))
    flight.step(20)
    now, modes = time.monotonic(), []
    for tick in range(20, 130):
        flight.tick, now = tick, now + DT
        sample = dataclasses.replace(flight.measurement(now), state=np.full(15, np.nan))
        flight.bus.publish("sample", sample.pack())
        setpoint = flight.loop.tick(now)
        flight.loop.idle()
        modes.append(flight.loop.mode)
        assert setpoint.tick == tick  # the plant accepts no other command
        assert flight.loop.stamp == Stamp(tick, sample.send_time)
        if setpoint.is_final:
            break
    assert modes[:4] == [Mode.POLICY] * 4
    assert 95 <= modes.count(Mode.BLIND) <= 105
    assert modes[-1] == Mode.DROP
    assert setpoint.ending(0.87) == "stopped without measurements at 0.87 m"
    assert flight.status["refused"] == {"sample": len(modes)}
    assert np.isfinite(FlightRows.unpack(flight.bus.latest("flight").data).rows).all()


def test_last_tick_before_crash_is_reported():
    flight = Flight(hover_source())
    flight.step(20)
    flight.x = level(np.array([0.0, 0.0, -1.0]))
    flight.bus.publish("sample", flight.measurement(time.monotonic()).pack())
    flight.bus.publish("ended", pack_note("ended", reason="crashed"))
    flight.loop.idle()  # the sample and the end arrived while control was busy
    assert not flight.loop.over
    flight.loop.tick(time.monotonic())
    flight.loop.idle()
    assert flight.loop.over
    rows = FlightRows.unpack(flight.bus.latest("flight").data).rows
    np.testing.assert_array_equal(rows[:, 0], np.arange(21))
    assert rows[-1, TRUE][2] == -1.0


def test_all_ticks_are_reported_before_final_command(monkeypatch):
    flight, last = Flight(hover_source()), []
    flight.step(20)
    flight.loop.land("landing")
    publish = flight.bus.publish

    def note(topic, data):
        if topic == "setpoint" and Setpoint.unpack(data).is_final:
            last.append(FlightRows.unpack(flight.bus.latest("flight").data).rows[-1])
        publish(topic, data)

    monkeypatch.setattr(flight.bus, "publish", note)
    while not last:
        flight.step()
    assert last[0][0] == flight.tick - 1
    assert last[0][-1] == Mode.LANDED


def test_levels_then_lands_by_clock_without_measurements():
    flight = Flight(hover_source(), state_age=0.1)
    flight.step(20)
    now = time.monotonic()
    result = [flight.loop.tick(now + 0.02 * i) for i in range(1, 140)]
    modes = [setpoint.is_final for setpoint in result]
    assert flight.status["reason"].startswith("the newest measurement is")
    assert flight.loop.mode == Mode.DROP
    assert 100 <= modes.index(True) <= 110
    rows = FlightRows.unpack(flight.bus.latest("flight").data).rows
    blind = rows[rows[:, 0] > 19]  # each command without a request has a row
    assert (np.diff(blind[:, 0]) <= 2).all()
    assert sorted(set(blind[:, -1])) == [Mode.BLIND, Mode.DROP]
    assert not has_measurement(blind).any()
    assert has_measurement(rows[rows[:, 0] <= 19]).all()
    np.testing.assert_allclose(blind[:, 2], DT * (blind[:, 0] - 19), atol=DT)
    np.testing.assert_array_equal(blind[-1, COMMAND], np.zeros(4))


def test_lost_sample_holds_command():
    flight = Flight(hover_source(), x=level(x=0.4))
    flight.step(5)
    hold = flight.loop.tick(time.monotonic())
    np.testing.assert_array_equal(hold.u, flight.commands[-1])


def test_report_has_last_ticks_and_accepted_commands():
    flight = Flight(hover_source(), x=level(x=0.4), window=30)
    flight.step(20)
    flight.accepted = flight.accepted + np.eye(4)[0] / 2  # the plant accepted a different command
    flight.step(20)
    rows = FlightRows.unpack(flight.bus.latest("flight").data).rows
    assert rows.shape == (30, len(COLUMNS))
    np.testing.assert_array_equal(rows[:, 0], np.arange(9, 39))
    assert rows[10, COMMAND][0] == pytest.approx(flight.commands[19][0] + 0.5)


@pytest.mark.parametrize("slow", ["act", "target"])
def test_too_slow_controller_does_not_take_off(monkeypatch, slow):
    flight = Flight(hover_source())
    flight.loop.warm_up()
    part = getattr(flight.loop.pilot, slow)
    monkeypatch.setattr(flight.loop.pilot, slow, lambda *argument: time.sleep((SHARE - PHASE) * DT) or part(*argument))
    with pytest.raises(PlantError, match=r"takes \d+ ms here, in NumPy; in a tick of 20 ms"):
        flight.loop.warm_up()


def test_land_command():
    flight = Flight(hover_source())
    flight.step(20)
    flight.bus.publish("order", pack_note("order", order="land"))
    flight.step(250)
    assert flight.loop.mode == Mode.LANDED
    assert flight.status["reason"] == "landing"
    assert flight.x[2] < 0.15


def test_controller_receives_parameters_of_learner():
    result = setup()
    state = result.learner.init(result.new_policy(random.key(0)), random.key(1))
    other = result.new_policy(random.key(5))
    a = adaptive_source(result, state)
    b = adaptive_source(result, LearnerState(eqx.tree_at(lambda s: s.policy, state.policy, other), state.residual))
    assert a.base == b.base
    flight = Flight(a)
    flight.step()
    arrays = b.parameters["policy"]
    flight.bus.publish("parameters.policy", Parameters("policy", 1, a.base, 0.0, arrays).pack())
    flight.step(7)
    fresh = Flight(b, x=flight.x)
    assert flight.status["versions"]["policy"] == 1
    np.testing.assert_array_equal(flight.loop.pilot._parameters["policy"][0], fresh.loop.pilot._parameters["policy"][0])
    np.testing.assert_allclose(flight.step(), fresh.step(), atol=0.02)
