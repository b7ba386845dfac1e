"""Identification during a live flight: it reads rows of the flight and publishes the vehicle for the controller."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from live_helpers import TOPICS
from retrim import ConfigError, Scenario, Setup, changed, load
from retrim.config.vehicle_file import VehicleSpec
from retrim.evaluation.fleet import Fleet
from retrim.live.processes.controllers import adaptive_source, plain_source, vehicle_half
from retrim.live.processes.identifier import IdentifierLoop
from retrim.onboard.messages import COLUMNS, COMMAND, MEASURED, FlightRows, Parameters, last_note
from retrim.onboard.pilot import LivePilot
from retrim.onboard.topics import VEHICLE
from retrim.physics.path_family import PathBelief
from retrim.transport.in_process import InProcessBus

pytestmark = pytest.mark.usefixtures("as_a_user")

SHORT = {"num_updates": 10, "num_envs": 2, "horizon": 20, "hidden_sizes": (16, 16)}
BASE = "controller"
AT_REST = np.concatenate([[0.0, 0.0, 1.0], np.eye(3).ravel(), np.zeros(3)])


@pytest.fixture(scope="module")
def setup(as_a_user):
    return Setup.from_preset(changed(load("hover/any"), pretrain=SHORT))


@pytest.fixture(scope="module")
def rows(setup):
    """Return rows of a flight with a geometric controller, 40 ms of delay, 80 ms of lag and 80 % of the thrust."""
    vehicle = VehicleSpec(
        name="slow", mass=1.0, inertia=(0.01, 0.01, 0.02), arm=(0.1, 0.1), thrust_max=40.0,
        rates_max=(6.0, 6.0, 4.0), motor_tau=0.03, rate_lag=(0.08, 0.08, 0.08), rate_damping=(1.0, 1.0, 1.0),
    )  # fmt: skip
    scenario = Scenario("none", plant="second-order", vehicle=vehicle, delay=0.04, thrust_error=-0.2)
    model = dataclasses.replace(setup.preset, vehicle=dataclasses.replace(vehicle, command_delay=0.04))
    policy = setup.new_policy(jax.random.key(0))
    (flight,) = Fleet(model, policy, [scenario], methods=("geometric",), starts=1, seconds=6.0).run().flights
    log = flight.log
    result = np.zeros((len(log.t) - 1, len(COLUMNS)))
    result[:, 0], result[:, 1] = np.arange(len(result)), log.t[:-1]
    states = log.measured
    result[:, MEASURED] = np.concatenate([states.p, states.R.reshape(-1, 9), states.v], axis=1)[:-1]
    result[:, COMMAND] = log.u[1:]
    return result


def bus():
    return InProcessBus(TOPICS | {f"parameters.{VEHICLE}": 8192, "identified": 8192, "flight": 2_000_000})


def feed(loop, rows, every=7):
    """Publish rows as control does: each message repeats earlier rows."""
    for end in range(every, len(rows) + 1, every):
        loop.bus.publish("flight", FlightRows(rows[max(0, end - 150) : end]).pack())
        assert loop.step()
        while loop.step():
            pass


@pytest.fixture(scope="module")
def sample_flight(setup, rows):
    """Return an identifier after a flight, and the programs compiled in its warm-up and in flight."""
    programs = []

    def record(name, seconds, **about):
        if name.endswith("backend_compile_duration"):
            programs.append(about.get("fun_name"))

    loop = IdentifierLoop(setup.preset, BASE, bus())  # the first one of this process
    jax.monitoring.register_event_duration_secs_listener(record)
    loop.warm_up()
    before = list(programs)
    feed(loop, rows)
    jax.monitoring.unregister_event_duration_listener(record)
    return loop, before, programs[len(before) :]


@pytest.fixture
def identifier(sample_flight):
    loop, *_ = sample_flight
    return loop


@pytest.fixture(scope="module")
def source(setup):
    """Return the programs and parameters of the controller that flies the identified vehicle."""
    return plain_source(setup, setup.pilot(setup.new_policy(jax.random.key(0)), "base-id").controller)


def parameters(loop, expected, after=0):
    data = loop.bus.latest(f"parameters.{VEHICLE}").data
    return Parameters.unpack(data, expected, half=VEHICLE, base=BASE, after=after)


def test_vehicle_is_identified(setup, source, identifier):
    result = parameters(identifier, source.parameters[VEHICLE])
    centre, half_width, gain = (np.asarray(a) for a in result.arrays.values())
    family = setup.env.family
    path = family.path(jnp.asarray(centre))
    assert float(path.delay) == pytest.approx(0.04, abs=0.004)
    assert float(path.response.rate_lag[0]) == pytest.approx(0.08, rel=0.1)
    assert float(gain) == pytest.approx(0.8, abs=0.03)
    assert half_width[:2].max() < 0.3
    assert 1.0 < result.computed_from <= 6.0  # an unchanged vehicle is not sent again


def test_identification_is_reported_after_one_and_five_seconds(identifier):
    reports = last_note(identifier.bus, "identified")["reports"]
    assert [t for t, _ in reports] == [pytest.approx(1.0, abs=0.2), pytest.approx(5.0, abs=0.2)]
    assert all(text.startswith("thrust gain 0.") and "rate delay" in text for _, text in reports)


def test_estimate_does_not_depend_on_length_of_messages(setup, source, rows, identifier):
    other = IdentifierLoop(setup.preset, BASE, bus())
    feed(other, rows, every=50)
    (centre, width, gain), (centre_50, width_50, gain_50) = (
        tuple(map(np.asarray, parameters(loop, source.parameters[VEHICLE]).arrays.values()))
        for loop in (identifier, other)
    )
    assert (np.abs(centre - centre_50) < width + width_50).all()
    assert abs(gain - gain_50) < 0.02


def test_restarted_identifier_continues_versions(setup, source, rows, identifier):
    before = identifier.bus.latest(f"parameters.{VEHICLE}").version
    again = IdentifierLoop(setup.preset, BASE, identifier.bus)
    again.bus.publish("flight", FlightRows(rows[-150:]).pack())
    while again.step():
        pass
    assert parameters(again, source.parameters[VEHICLE], after=before).version == before + 1


def test_warm_up_compiles_all_programs(sample_flight):
    """The supervisor would kill a process that compiles in flight, since it sends no heartbeat."""
    _, before, in_flight = sample_flight
    assert {"jit(_measure)", "jit(_estimate)"} <= set(before)
    assert in_flight == []


def test_damaged_rows_are_ignored(setup):
    loop = IdentifierLoop(setup.preset, BASE, bus())
    loop.bus.publish("flight", b"no rows")
    assert not loop.step()


def test_preset_for_one_vehicle_is_refused():
    with pytest.raises(ConfigError, match="is for one vehicle"):
        IdentifierLoop(load("hover/retrim"), BASE, bus())


def test_excitation_in_live_flight_is_refused(setup):
    exciting = Setup.from_preset(changed(setup.preset, family={"excitation": True}))
    controller = exciting.pilot(exciting.new_policy(jax.random.key(0)), "base-id").controller
    with pytest.raises(ConfigError, match=r"family\.excitation: a live flight does not excite its vehicle"):
        plain_source(exciting, controller)


def test_only_identifying_controller_has_vehicle_parameters(setup):
    policy = setup.new_policy(jax.random.key(0))
    assert vehicle_half(setup, setup.pilot(policy, "base-id").controller).keys() == {VEHICLE}
    assert vehicle_half(setup, setup.pilot(policy, "base-do").controller) == {}


def test_controller_follows_slowly_and_keeps_vehicle_after_restart(source):
    pilot = LivePilot(source)
    pilot.reset(AT_REST)
    steady = [pilot.act(0.02 * k, 0.0, AT_REST) for k in range(50)][-1]
    message = PathBelief.between(jnp.full(4, -1.0), jnp.full(4, -0.9))
    arrays = dict(zip(source.parameters[VEHICLE], (message.centre, message.half_width, jnp.array(0.5)), strict=True))
    pilot.swap(Parameters(VEHICLE, 1, source.base, 1.0, {n: np.asarray(a) for n, a in arrays.items()}))
    after = [pilot.act(0.02 * k, 0.0, AT_REST) for k in range(50, 100)]
    steps = np.abs(np.diff([steady, *after], axis=0))[:, 0]
    assert steps.max() < 0.1 * 9.81  # [m/s^2]
    assert after[-1][0] > 1.5 * steady[0]  # half the thrust per command: twice the command
    pilot.restart()
    assert pilot.versions[VEHICLE] == 1
    assert pilot.act(2.0, 0.0, AT_REST)[0] > 1.5 * steady[0]


def test_learning_flight_of_vehicle_file_without_lag_has_numpy_form(setup):
    """The step response of its rate loop and the start of the estimator are numbers while the flight is traced."""
    vehicle = VehicleSpec(
        name="new", mass=0.7, inertia=(0.003, 0.003, 0.005), arm=(0.09, 0.09), thrust_max=30.0,
        rates_max=(10.0, 10.0, 5.0), motor_tau=0.03,
    )  # fmt: skip
    result = Setup.from_preset(changed(setup.preset, vehicle=vehicle))
    state = result.learner.init(result.new_policy(jax.random.key(0)), jax.random.key(1))
    assert VEHICLE in adaptive_source(result, state).parameters
