"""Values from a board's own log are within a tenth of the truth, or the report gives the reason for their absence."""

import json
import tomllib

import jax.numpy as jnp
import numpy as np
import pytest

from fake_blackbox import blackbox
from fake_body_flight import DT, BodyFlight, Truth, fly_body
from fake_dataflash import body_messages, dataflash
from retrim.config.setup import Setup
from retrim.config.validation import validate
from retrim.config.vehicle_file import VehicleSpec
from retrim.errors import ConfigError, LogError
from retrim.estimation.command_path.response import mean_step_response
from retrim.io.logs import BodyLog, read_log
from retrim.replay import body_identification
from retrim.replay.body_identification import identify_body
from retrim.replay.body_replay import body_section, replay_body
from retrim.replay.replay import Replay, replay
from retrim.replay.response_fit import Path as ResponsePath
from retrim.replay.response_fit import mean_response, respond
from retrim.runkit.reporter import Silent
from retrim.runkit.run import Run

SLOWER = Truth(delay=0.02, lag=0.08, damping=1.2, yaw_lag=0.15, gain=0.9, hover=0.45, curve=0.0, thrust_lag=0.08)
TRUTHS = {"a five-inch quadrotor": Truth(), "a slow and heavy one": SLOWER}
TENTH = 0.1


@pytest.fixture(autouse=True)
def few_draws(monkeypatch):
    monkeypatch.setattr(body_identification, "DRAWS", 8)


def thin(flight, every):
    return BodyFlight(*(getattr(flight, name)[::every] for name in ("t", "command", "rates", "motors", "force")))


def log_of(flight, every=4, **changes):
    """Return the log of a board, without a file."""
    f = thin(flight, every)
    columns = {
        "t": f.t, "motors": f.motors, "rates": f.rates, "command": f.command, "specific_force": f.force,
        "valid": np.ones(len(f.t), dtype=bool), "dt": DT * every, "curve": None, "filter_lag": 0.0, "notes": (),
    } | changes  # fmt: skip
    return BodyLog(**columns)


def assert_agrees(result, truth, *, forces=True):
    """Assert that every value is within a tenth of the truth, or within 2 ms or 0.1 if a tenth is less."""
    found = result.vehicle
    assert found.delay.value == pytest.approx(truth.delay, rel=TENTH, abs=2e-3)
    assert found.rate_lag.value == pytest.approx(truth.lag, rel=TENTH)
    assert found.rate_damping.value == pytest.approx(truth.damping, rel=TENTH)
    assert found.yaw_lag.value == pytest.approx(truth.yaw_lag, rel=TENTH)
    assert found.rate_gain.value == pytest.approx(truth.gain, rel=TENTH)
    assert found.yaw_gain.value == pytest.approx(truth.gain, rel=TENTH)
    if forces:
        assert result.hover.value == pytest.approx(truth.hover, rel=TENTH)
        assert found.thrust_lag.value == pytest.approx(truth.thrust_lag, rel=TENTH)
        assert result.curve.value == pytest.approx(truth.curve, abs=0.1)
    for each in (found.delay, found.rate_lag, found.rate_gain, result.hover):
        assert each is None or each.low <= each.high


@pytest.mark.parametrize("name", TRUTHS)
def test_identification_recovers_blackbox_parameters(name, tmp_path):
    """The test covers all steps: bytes of a log, frames, units and regression."""
    truth = TRUTHS[name]
    (tmp_path / "flight.bbl").write_bytes(blackbox(thin(fly_body(11.0, truth), 4)))
    result = identify_body(read_log(tmp_path / "flight.bbl"))
    assert_agrees(result, truth)
    assert min(result.explained.values()) > 0.9


def test_identification_recovers_dataflash_parameters(tmp_path):
    truth = Truth(curve=0.0)
    data = dataflash(body_messages(thin(fly_body(11.0, truth), 5)), without=("XKF1",))
    (tmp_path / "flight.bin").write_bytes(data)
    assert_agrees(identify_body(read_log(tmp_path / "flight.bin")), truth)


def test_accelerometer_filter_is_separate_from_thrust_lag():
    truth, lag = Truth(), 0.02
    flight = fly_body(11.0, truth)
    filtered = respond(flight.force, DT, ResponsePath(0.0, lag, 1.0 / 3.0))
    log = log_of(BodyFlight(flight.t, flight.command, flight.rates, flight.motors, filtered))
    longer = identify_body(log).vehicle
    through = identify_body(log_of(BodyFlight(flight.t, flight.command, flight.rates, flight.motors, filtered),
                                   filter_lag=lag))  # fmt: skip
    assert_agrees(through, truth)
    assert longer.thrust_lag.value > truth.thrust_lag * 1.1


def test_stated_thrust_curve_is_used():
    truth = Truth(curve=0.6)
    result = identify_body(log_of(fly_body(11.0, truth), curve=0.6))
    assert result.curve is None or result.curve.value == 0.6
    assert result.hover.value == pytest.approx(truth.hover, rel=0.02)


def test_flight_at_rest_identifies_nothing():
    """At rest there is only noise, and the rate loop and the thrust map remain unknown."""
    rng, flight = np.random.default_rng(0), fly_body(11.0)
    noise = 0.01 * rng.normal(size=flight.rates.shape)
    still = BodyFlight(
        flight.t, 0.0 * flight.command, noise, 0.0 * flight.motors + 0.3, flight.force[:1] + 10.0 * noise
    )
    result = identify_body(log_of(still))
    assert result.vehicle.delay is result.vehicle.rate_lag is result.vehicle.yaw_gain is None
    assert result.vehicle.thrust_lag is result.hover is None
    assert not result.known


def test_short_flight_is_refused():
    with pytest.raises(LogError, match="identification needs at least 8 s"):
        identify_body(log_of(fly_body(5.0)))


def test_response_equals_estimator_in_flight():
    age = np.linspace(-0.01, 0.5, 60)
    for ringing in (0.0, 0.2, 1.0 / 3.0, 0.5, 0.8):
        ours = mean_response(age, 0.004, ResponsePath(0.01, 0.03, ringing))
        theirs = mean_step_response(*(jnp.asarray(x) for x in (age - 0.01, 0.004, 0.03, ringing)))
        np.testing.assert_allclose(ours, theirs, atol=2e-3)


def test_report_has_values_and_reasons_for_missing_ones(tmp_path):
    (tmp_path / "flight.bbl").write_bytes(blackbox(thin(fly_body(11.0), 4)))
    run = Run("replay", tmp_path / "out")
    replay(tmp_path / "flight.bbl", Replay(identify=True), run, Silent())
    text = (tmp_path / "out" / "replay.md").read_text()
    assert "| linear drag | needs positions or velocities, and attitudes |" in text
    assert "| motor command at hover | 0.3 (" in text
    assert "add the delay of the link" in text
    result = json.loads((tmp_path / "out" / "replay.json").read_text())
    assert result["identified"]["rate_lag"][0] == pytest.approx(Truth().lag, rel=TENTH)
    assert result["identified"]["hover"][0] == pytest.approx(Truth().hover, rel=TENTH)
    spec = validate(VehicleSpec, tomllib.loads((tmp_path / "out" / "vehicle.toml").read_text()), source="vehicle")
    assert spec.rate_lag[0] == pytest.approx(Truth().lag, rel=TENTH)
    assert spec.rate_damping[0] == pytest.approx(Truth().damping, rel=TENTH)
    assert spec.command_delay == pytest.approx(Truth().delay, abs=2e-3)


def test_missing_accelerometer_or_commands_are_reported():
    flight = fly_body(11.0)
    log = log_of(flight, specific_force=None)
    rows = dict(body_section(log, identify_body(log)).rows)
    assert (
        rows["motor command at hover"] == rows["lag of thrust"] == "needs an accelerometer, and a thrust that changes"
    )
    assert rows["lag of roll and pitch rates"].startswith("3")
    log = log_of(flight, command=None)
    rows = dict(body_section(log, identify_body(log)).rows)
    assert rows["roll and pitch rate per command"] == "needs commanded rates that change"
    assert rows["motor command at hover"].startswith("0.3")


def test_rates_unrelated_to_commands_are_reported():
    log = log_of(fly_body(11.0, Truth(gain=0.5)))
    about = body_section(log, identify_body(log)).about
    assert "**The roll and pitch rates are 0.50 times the commanded ones**" in about


def test_adaptation_is_refused_and_flights_are_numbered_from_one(tmp_path):
    log, setup = log_of(fly_body(2.0)), Setup.from_preset("hover/retrim")
    with pytest.raises(LogError, match="--adapt full: the log has no attitudes and velocities"):
        replay_body(log, tmp_path / "flight.bbl", setup, Run("replay", tmp_path), Silent(), identify=False, seed=0,
                    adapt="full")  # fmt: skip
    with pytest.raises(ConfigError, match="--flight 0: flights are numbered from 1"):
        Replay(flight=0)
