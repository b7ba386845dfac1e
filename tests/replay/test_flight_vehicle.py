"""The vehicle file that is identified from a flight of retrim."""

import dataclasses

import jax
import jax.numpy as jnp
import pytest

from retrim import Scenario, Setup, load
from retrim.adapt.vehicles import estimate_path
from retrim.config.vehicle_file import VehicleSpec, read_vehicle
from retrim.errors import ConfigError
from retrim.estimation.command_path import PathEstimator
from retrim.evaluation.fleet import Fleet
from retrim.replay import flight_vehicle
from retrim.replay.flight_vehicle import check_vehicle_file, write_flight_vehicle
from retrim.replay.identification import Estimate
from retrim.replay.vehicle import MARK

pytestmark = pytest.mark.usefixtures("as_a_user")

VEHICLE = VehicleSpec(
    name="slow", mass=1.0, inertia=(0.01, 0.01, 0.02), arm=(0.1, 0.1), thrust_max=40.0, rates_max=(6.0, 6.0, 4.0),
    motor_tau=0.04, rate_lag=(0.08, 0.08, 0.12), rate_damping=(0.7, 0.7, 0.7), command_delay=0.03,
)  # fmt: skip


@pytest.fixture(scope="module")
def sample_flight(as_a_user):
    """Return a flight of a second-order vehicle by a geometric controller, and a setup without this vehicle."""
    scenario = Scenario("kick", plant="second-order", vehicle=VEHICLE, delay=0.03)
    model = dataclasses.replace(load("hover/retrim"), vehicle=VEHICLE)
    policy = Setup.from_preset(model).new_policy(jax.random.key(0))
    (flight,) = Fleet(model, policy, [scenario], methods=("geometric",), starts=1, seconds=12.0).run().flights
    return flight, Setup.from_preset("hover/retrim")


@pytest.fixture(scope="module")
def command_path(sample_flight):
    """Return the command path of the flight."""
    log = sample_flight[0].log
    window = jax.tree.map(jnp.asarray, log.window(len(log.t) - 1))
    return jax.jit(estimate_path)(PathEstimator.of(log.dt, memory=flight_vehicle.MEMORY), window)


@pytest.fixture
def known_path(command_path, monkeypatch):
    """Do not estimate the path again."""
    monkeypatch.setattr(flight_vehicle, "estimate_path", lambda estimator, window: command_path)


def test_file_has_delay_lags_and_damping_of_vehicle(sample_flight, tmp_path):
    flight, setup = sample_flight
    path = tmp_path / "found.toml"
    faults = []
    assert write_flight_vehicle(flight, setup, path, faults, tmp_path) == [path]
    assert not faults
    result = read_vehicle(path)
    assert result.command_delay == pytest.approx(0.03, abs=0.002)
    assert result.rate_lag[0] == pytest.approx(0.08, rel=0.05)
    assert result.rate_damping[0] == pytest.approx(0.7, rel=0.1)
    assert result.motor_tau == pytest.approx(0.04, rel=0.15)


@pytest.mark.usefixtures("known_path")
def test_file_has_limits_of_vehicle_flown(sample_flight, tmp_path):
    """A flight does not reveal them: they come from the vehicle of the scenario, or else from that of the policy."""
    flight, setup = sample_flight
    usual = dataclasses.replace(flight, spec=dataclasses.replace(flight.spec, scenario=Scenario()))
    for each, expected in ((flight, VEHICLE.build()), (usual, setup.vehicle)):
        path = tmp_path / "found.toml"
        assert write_flight_vehicle(each, setup, path, [], tmp_path) == [path]
        result = read_vehicle(path)
        assert (result.mass, result.thrust_max) == pytest.approx((float(expected.mass), float(expected.thrust_max)))
        assert result.rates_max == pytest.approx(expected.omega_max.tolist())


@pytest.mark.usefixtures("known_path")
def test_file_states_policy_and_results_of_flight(sample_flight, tmp_path):
    """The names come from the flight, and cannot add a line to the file."""
    flight, setup = sample_flight
    spec = dataclasses.replace(flight.spec, start=3, seed=7)
    path, folder = tmp_path / "found.toml", tmp_path / "run\nmass = 9"
    assert write_flight_vehicle(dataclasses.replace(flight, spec=spec), setup, path, [], folder) == [path]
    source = "a flight of hover/retrim with geometric, seed 7, start 3, in the folder run.mass . 9"
    assert path.read_text().splitlines()[0] == f"{MARK} {source}. Values without a remark are those of 'slow'."


@pytest.mark.usefixtures("known_path")
def test_vehicle_that_cannot_be_flown_is_written_and_reported(sample_flight, tmp_path, monkeypatch):
    path, faults, write = tmp_path / "found.toml", [], flight_vehicle.vehicle_toml
    weak = Estimate(13.0, 12.0, 14.0)
    monkeypatch.setattr(
        flight_vehicle, "vehicle_toml", lambda found, *rest: write(dataclasses.replace(found, full_thrust=weak), *rest)
    )
    assert write_flight_vehicle(*sample_flight, path, faults, tmp_path) == [path]
    (fault,) = faults
    assert fault.startswith(f"--save-vehicle {path}: the vehicle is identified, but cannot fly: thrust_max = ")
    assert "\n" not in fault


def test_no_file_is_written_without_option(sample_flight, tmp_path):
    assert write_flight_vehicle(*sample_flight, None, [], tmp_path) == []
    check_vehicle_file(None)


def test_too_short_flight_is_refused_in_one_line(sample_flight, tmp_path):
    flight, setup = sample_flight
    log = flight.log
    cut = lambda states: type(states)(*(part[:20] for part in states))  # noqa: E731
    short = log._replace(
        t=log.t[:20], u=log.u[:20], true=cut(log.true), measured=cut(log.measured), age=log.age, events=()
    )
    path = tmp_path / "found.toml"
    faults = []
    assert write_flight_vehicle(dataclasses.replace(flight, log=short), setup, path, faults, tmp_path) == []
    assert not path.exists()
    assert "must be at least 1 s long to identify its vehicle" in faults[0]


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("found.txt", "must end with .toml"),
        ("nowhere/found.toml", "does not exist; create it first"),
        ("/proc/found.toml", "cannot be written there .* choose a different --save-vehicle"),
        ("folder.toml", "exists, and is not an identified vehicle; choose another name"),
        ("mine.toml", "exists, and is not an identified vehicle; choose another name"),
        ("flown.toml", "is the file of --vehicle; choose another name"),
        ("link.toml", "is the file of --vehicle; choose another name"),
    ],
)
def test_unwritable_file_is_refused_before_flight(tmp_path, name, message):
    (tmp_path / "folder.toml").mkdir()
    (tmp_path / "mine.toml").write_text("name = 'mine'\n")
    flown = tmp_path / "flown.toml"
    flown.write_text(f"{MARK} a flight.\n")
    (tmp_path / "link.toml").symlink_to(flown)
    with pytest.raises(ConfigError, match=message):
        check_vehicle_file(tmp_path / name, str(flown))
    check_vehicle_file(flown, "small")  # of an earlier flight: it may be replaced
    assert "name = 'mine'" in (tmp_path / "mine.toml").read_text()
