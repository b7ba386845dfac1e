"""Fleets: equal rows on any executor, progress, and finished flights after an interruption."""

import dataclasses
import multiprocessing
import re
import signal
import threading
import types
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fake_flights
from helpers import brief_preset, tiny_preset
from retrim import ConfigError, Fleet, PlantError, Scenario, Setup, enable_compile_cache, load
from retrim.config.loading import dump
from retrim.evaluation import batches as batching
from retrim.evaluation import executor as gathering
from retrim.evaluation import fleet as fleet_module
from retrim.evaluation import jobs
from retrim.evaluation.jobs import setup_for
from retrim.physics import State
from retrim.runkit import flying
from retrim.runkit.flights import FlightSpec

pytestmark = pytest.mark.usefixtures("as_a_user")

SCENARIOS = [Scenario("small", plant="simple"), Scenario("gusts", plant="simple", sensors="mocap")]


@pytest.fixture(scope="module")
def fleet(as_a_user):
    """Return eight flights of two untrained policies, too short for a crash."""
    preset = brief_preset()
    setup = Setup.from_preset(preset)
    policies = {seed: setup.new_policy(jax.random.key(seed)) for seed in (0, 5)}
    return Fleet(preset, policies, SCENARIOS, starts=1, seconds=1.2)


def two_batches(fleet):
    """Return flights of two programs: adapting flights, and flights with random disturbances and measurements."""
    expected = {("small", "full"), ("gusts", "base")}
    return [spec for spec in fleet.specs if (spec.scenario.disturbance, spec.method) in expected]


@pytest.fixture(scope="module")
def programs(fleet):
    """Return the programs that were compiled in the fleet's first flights, after its warm-up."""
    result = list[str]()

    def note(name, seconds, **about):
        if name.endswith("backend_compile_duration"):
            result.append(name)

    fleet.warm_up()
    jax.monitoring.register_event_duration_secs_listener(note)
    with ThreadPoolExecutor(2) as pool:
        flights = fleet.run(pool)
    jax.monitoring.unregister_event_duration_listener(note)
    return flights, result


@pytest.fixture(scope="module")
def flights(programs):
    return programs[0]


def test_tick_is_not_compiled_after_warm_up(programs, fleet):
    """The score of a flight is compiled once, after the first flights."""
    assert len(programs[1]) <= 3


def test_warm_up_uses_measurements_of_plant(fleet, monkeypatch):
    """Otherwise, a method that uses body rates compiles a second program at take-off."""
    measurements = []
    monkeypatch.setattr(Setup, "pilot", lambda *_, **__: types.SimpleNamespace(warm_up=measurements.append))
    monkeypatch.setattr(fleet_module, "fly_one", lambda *_, **__: None)
    fleet.warm_up(fleet.specs[:1])
    assert measurements[0].omega is not None
    assert measurements[0].a is not None


def test_every_combination_is_flown_once_in_order(fleet, flights):
    assert [flight.spec for flight in flights.flights] == fleet.specs
    assert len(set(fleet.specs)) == 8
    assert not flights.interrupted
    result = flights.rows()
    assert [(row["disturbance"], row["method"], row["n"], row["crashes"]) for row in result] == [
        (name, method, 2, 0) for name in ("small", "gusts") for method in ("base", "full")
    ]
    assert all(np.isfinite(row["mean"]) for row in result)
    kinds = {event.kind for flight in flights.flights for event in flight.events}
    assert {"residual", "policy"} & kinds == {"residual"} | ({"policy"} & kinds)
    assert all(flight.events == () for flight in flights.flights if flight.spec.method == "base")


def test_one_thread_and_another_process_give_same_flights(fleet, flights):
    with ThreadPoolExecutor(1) as pool:
        assert fleet.run(pool).rows() == flights.rows()
    context, part = multiprocessing.get_context("spawn"), [fleet.specs[5], fleet.specs[7]]
    assert [(spec.scenario, spec.method, spec.seed) for spec in part] == [
        (SCENARIOS[1], "base", 5), (SCENARIOS[1], "full", 5)
    ]  # fmt: skip
    with ProcessPoolExecutor(1, mp_context=context, initializer=enable_compile_cache) as pool:
        elsewhere = fleet.run(pool, only=part)
    assert [flight.spec for flight in elsewhere.flights] == part
    for there, here in zip(elsewhere.flights, (flights.flights[5], flights.flights[7]), strict=True):
        np.testing.assert_array_equal(there.log.p, here.log.p)
        assert there.events == here.events
        assert (there.learner_state is None) == (here.learner_state is None)


@pytest.mark.parametrize("cores", [1, 2, 3, 8, 16, 64])
@pytest.mark.parametrize("n", [1, 2, 3, 5, 7, 8, 9, 24, 65])
def test_single_flight_does_not_get_its_own_lot(monkeypatch, n, cores):
    """This holds for any number of cores: Python steps a single flight, and that uses one core."""
    monkeypatch.setattr(batching, "lanes", lambda: cores)
    group = [FlightSpec(Scenario("small"), "base", start) for start in range(n)]
    result = batching.in_batches([group], lambda specs: "program")
    assert sorted((spec for batch in result for spec in batch.specs), key=group.index) == group
    sizes = [len(batch.specs) for batch in result]
    assert n == 1 or min(sizes) > 1
    assert max(sizes) <= max(2, -(-n // cores)) + 1
    assert [len(batch.specs) for batch in batching.in_batches([group], lambda specs: None)] == [1] * n


def test_other_lots_wait_for_compilation_not_for_landing(monkeypatch):
    preset = brief_preset()
    policy = Setup.from_preset(preset).new_policy(jax.random.key(0))
    fleet = Fleet(preset, policy, SCENARIOS[:1], methods=("base",), starts=4, seconds=2.0)
    order, other = [], threading.Event()

    def fly_once(setup, policies, specs, *_, progress, cold, **__):
        order.append("first" if cold else "other")
        if cold:
            progress(0.1)
            assert not other.wait(0.1)
            progress(0.6)
            assert other.wait(20.0)
        other.set()
        order.append("first landed" if cold else "other landed")
        return [fake_flights.flight(0.1, spec=spec) for spec in specs]

    monkeypatch.setattr(batching, "lanes", lambda: 2)
    monkeypatch.setattr(fleet_module, "lanes", lambda: 2)
    monkeypatch.setattr(fleet_module, "fly_batch", fly_once)
    fleet.run()
    assert order[:2] == ["first", "other"]


def test_lots_equal_single_flights_up_to_rounding(fleet, flights, monkeypatch):
    """Two flights of a scenario and a method run as one program; a third one runs alone."""
    monkeypatch.setattr(batching, "CPU_LIMIT", 2)
    monkeypatch.setattr(batching, "lanes", lambda: 1)
    assert [len(batch.specs) for batch in fleet.make_batches(fleet.specs)] == [2, 2, 2, 2]
    assert [len(batch.specs) for batch in fleet.make_batches(fleet.specs[:3])] == [2, 1]
    assert [batch.compiles for batch in fleet.make_batches(fleet.specs)] == [
        True
    ] * 4  # different disturbances need different programs
    on_result, message = [], []
    together = fleet.run(
        only=two_batches(fleet), on_result=on_result.append, progress=lambda done, n: message.append(done)
    )
    alone = {flight.spec: flight for flight in flights.flights}
    assert [flight.spec for flight in together.flights] == two_batches(fleet)
    assert sorted(len(batch) for batch in on_result) == [2, 2]
    assert message == sorted(message)
    assert message[-1] == 4
    for flight in together.flights:
        other = alone[flight.spec]
        np.testing.assert_allclose(flight.log.p, other.log.p, atol=2e-4)
        assert [(e.t, e.kind) for e in flight.events] == [(e.t, e.kind) for e in other.events]
        assert (flight.learner_state is None) == (other.learner_state is None)


def test_discarded_flights_have_finished(fleet, flights, monkeypatch):
    monkeypatch.setattr(batching, "CPU_LIMIT", 2)
    monkeypatch.setattr(batching, "lanes", lambda: 1)
    on_result = []
    loss = fleet.run(only=two_batches(fleet), on_result=on_result.extend, forget=True)
    assert loss.flights == []
    assert not loss.interrupted
    assert {flight.spec for flight in on_result} == set(two_batches(fleet))


def test_lot_terminates_each_flight_at_its_tick(fleet):
    """A vehicle that is pushed to the ground is terminated at the same tick as in a single flight."""
    scenario = Scenario("push=-8", plant="simple")
    down = Fleet(fleet.preset, fleet.policies, [scenario], methods=("base",), starts=2, seconds=2.0)
    with ThreadPoolExecutor(1) as pool:
        alone = down.run(pool).flights
    together = down.run().flights
    assert any(flight.log.terminated for flight in alone)
    for flight, other in zip(together, alone, strict=True):
        assert flight.log.terminated == other.log.terminated
        assert len(flight.log.t) == len(other.log.t) == len(flight.error) == len(flight.log.u)


def test_lot_with_different_flight_is_flown_one_by_one(fleet, flights, monkeypatch):
    """The first two flights of a batch are equal; all of them are compared before the flight."""

    look = []

    def alike(plants, pilots):
        look.append(len(plants))
        return len(look) == 1  # during planning, not during the flight

    monkeypatch.setattr(batching, "lanes", lambda: 1)
    monkeypatch.setattr(flying, "can_fly_together", alike)
    part = [spec for spec in fleet.specs if spec.method == "base"][:2]
    alone = {flight.spec: flight for flight in flights.flights}
    trajectory = fleet.run(only=part).flights
    assert look == [2, 2]
    assert [flight.spec for flight in trajectory] == part
    for flight in trajectory:
        np.testing.assert_array_equal(flight.log.p, alone[flight.spec].log.p)


def test_progress_counts_finished_flights(fleet):
    message = []
    part = fleet.specs[:3]
    with ThreadPoolExecutor(1) as pool:
        flight = fleet.run(pool, only=part, progress=lambda done, n: message.append((done, n)))
    assert message == [(1, 3), (2, 3), (3, 3)]
    assert [flight.spec for flight in flight.flights] == part


def test_progress_of_lot_is_reported_in_flight(fleet, monkeypatch):
    monkeypatch.setattr(gathering, "REPORT_PERIOD", 0.001)
    monkeypatch.setattr(batching, "lanes", lambda: 1)
    message = []
    part = [spec for spec in fleet.specs if spec.method == "full"][:2]
    fleet.run(only=part, progress=lambda done, n: message.append(done))
    assert message == sorted(message)
    assert any(0.0 < done < 2.0 for done in message)
    assert message[-1] == 2


@pytest.mark.parametrize("by", ["event", "ctrl-c"])
def test_interruption_keeps_finished_flights(fleet, by):
    stop = threading.Event()

    def progress(done, n):
        if done == 2:
            stop.set() if by == "event" else signal.raise_signal(signal.SIGINT)

    with ThreadPoolExecutor(1) as pool:
        result = fleet.run(pool, stop=stop, progress=progress)
    assert stop.is_set()
    assert result.interrupted
    assert 2 <= len(result.flights) < 8
    assert [flight.spec for flight in result.flights] == fleet.specs[: len(result.flights)]
    assert sum(row["n"] for row in result.rows()) == len(result.flights)
    assert fleet.run(stop=stop).flights == []


def test_failing_plant_ends_fleet(fleet, monkeypatch):
    def break_policy(setup, policy, spec, *rest, **more):
        raise PlantError(f"no plant for {spec.method}")

    monkeypatch.setattr(fleet_module, "fly_one", break_policy)
    with ThreadPoolExecutor(1) as pool, pytest.raises(PlantError, match="no plant for"):
        fleet.run(pool)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"starts": 0}, "0 starts: must be 1 to"),
        ({"seconds": 0.0}, "flights of 0 s: must be"),
        ({"seconds": float("nan")}, "flights of nan s: must be"),
        ({"scenarios": []}, "nothing to fly"),
        ({"methods": ()}, "nothing to fly"),
        ({"methods": ("best",)}, "no method 'best'"),
        ({"scenarios": [Scenario(reference="circle")]}, "a hover policy follows no reference"),
        ({"seed": 2**32}, "seed 4294967296: must be 0 to"),
    ],
)
def test_invalid_fleet_is_refused(fleet, change, message):
    policy = next(iter(fleet.policies.values()))
    scenarios, seed = change.pop("scenarios", SCENARIOS), change.pop("seed", 0)
    with pytest.raises(ConfigError, match=message):
        Fleet(load("hover/fast"), {seed: policy}, scenarios, **change)


def test_process_builds_setup_once_per_fleet():
    text = dump(dataclasses.replace(tiny_preset(), name="once"))
    assert setup_for(text, None, "a") is setup_for(text, None, "a")
    assert setup_for(text, None, "a") is not setup_for(text, None, "b")
    assert setup_for(text).preset.name == "once"


@pytest.mark.parametrize(
    ("off", "why"),
    [
        ((0.0, 0.0, -1.499), r"^below -0\.5 m, under the ground, at \(0\.00, 0\.00, -0\.5\d\) m$"),
        ((-4.99, 0.0, 0.0), r"^5\.\d\d m off, out of the task's bounds, at \(-5\.\d\d, 0\.00, 1\.00\) m$"),
    ],
)
def test_crash_event_states_cause(fleet, off, why):
    """The cause is the last event of the flight, alone or in a batch."""
    setup, policy, spec = fleet.setups[None], fleet.policies[0], fleet.specs[0]
    x0 = State(jnp.array(fleet.preset.goal) + jnp.array(off), jnp.eye(3), 3.0 * jnp.array(off))
    alone = flying.fly_one(setup, policy, spec, x0, 0.4)
    for flight in (
        alone,
        *flying.fly_batch(setup, [policy] * 2, [spec, dataclasses.replace(spec, start=1)], [x0, x0], 0.4),
    ):
        assert flight.log.terminated
        assert flight.events[-1].kind == "terminated"
        assert flight.events[-1].t == pytest.approx(flight.log.t[-1])
        assert re.search(why, flight.events[-1].note)


def test_every_flight_receives_initial_learner_state(monkeypatch):
    """The flights run alone, in a batch, or as a remote job."""
    preset, message = brief_preset(), []
    setup = Setup.from_preset(preset)
    policy = setup.new_policy(jax.random.key(0))
    state = setup.learner.init(policy, jax.random.key(1))
    fleet = Fleet(preset, policy, SCENARIOS[:1], methods=("full",), starts=2, seconds=1.2, state=state)

    def flies(kind, answer):
        def fly_once(*_, state=None, **__):
            message.append((kind, state))
            return answer

        return fly_once

    for module in (fleet_module, jobs):
        monkeypatch.setattr(module, "fly_batch", flies("lot", []))
        monkeypatch.setattr(module, "fly_one", flies("one", fake_flights.flight(0.1)))
    for batch in (*fleet.make_batches(fleet.specs), *fleet.make_batches(fleet.specs[:1])):
        fleet._fly(batch, lambda share: None, threading.Event())
        jobs.fly_job(fleet._job(batch.specs, True))
    assert [kind for kind, _ in message] == ["lot", "lot", "one", "one"]
    assert all(each is state for _, each in message)
