"""Identification recovers the parameters of a flight within the stated interval, and reports no unobservable ones."""

import dataclasses
import tomllib
from itertools import accumulate

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from retrim.config.validation import validate
from retrim.config.vehicle_file import VehicleSpec
from retrim.errors import LogError
from retrim.io.logs import FlightLog
from retrim.replay import identification
from retrim.replay.identification import identify
from retrim.replay.rows import acting_commands
from retrim.replay.vehicle import vehicle_toml

DT, SUB = 0.02, 20
TICKS = 900  # flights of one length are identified by one program


DRAWS = 50  # bootstrap samples, a quarter of the usual number


@pytest.fixture(autouse=True)
def few_draws(monkeypatch):
    monkeypatch.setattr(identification, "DRAWS", DRAWS)


def wander(rng, n, size, tau):
    """Return a mean-reverting random walk."""
    x = np.zeros(n)
    for i in range(1, n):
        x[i] = x[i - 1] * np.exp(-DT / tau) + size * np.sqrt(1 - np.exp(-2 * DT / tau)) * rng.normal()
    return x


def excited_flight(seed, *, delay, lag, rate_lag, gain, drag, n=TICKS, noise=1.0, size=1.0):
    """Return a vehicle under random commands, integrated in steps of 1 ms, with mild noise on the log."""
    rng, h = np.random.default_rng(seed), DT / SUB
    c = 9.81 / gain + size * wander(rng, n, 1.5, 0.3)
    w = size * np.stack([wander(rng, n, 0.8, 0.2), wander(rng, n, 0.8, 0.2), wander(rng, n, 0.5, 0.5)], axis=1)
    j = np.maximum(0, np.arange(n * SUB) - round(delay / h)) // SUB
    keep, start_time = np.exp(-h / np.array([lag, *rate_lag])), np.array([9.81 / gain, 0.0, 0.0, 0.0])
    acts = np.stack(
        [_first_order(u, k, at) for u, k, at in zip(np.column_stack([c, w])[j].T, keep, start_time, strict=True)]
    )
    thrust, turns = acts[0], _turns(h * acts[1:].T)
    R = np.stack(list(accumulate(turns[:-1], np.matmul, initial=np.eye(3))))
    push = h * (gain * thrust[:, None] * R[:, :, 2] - np.array([0, 0, 9.81]))
    decay = np.eye(3) - h * (R * np.array(drag)) @ np.swapaxes(R, 1, 2)
    steps = zip(decay[:-1], push[:-1], strict=True)
    v = np.stack(list(accumulate(steps, lambda v, step: step[0] @ v + step[1], initial=np.zeros(3))))
    p = h * (np.cumsum(v, axis=0) - v)
    p, v, R = (x[::SUB] for x in (p, v, R))
    R = R @ Rotation.from_rotvec(1e-3 * noise * rng.normal(size=(n, 3))).as_matrix()
    v = v + 3e-3 * noise * rng.normal(size=v.shape)
    valid = np.ones(n, dtype=bool)
    return FlightLog(DT * np.arange(n), p, R, v, np.zeros_like(v), c, np.zeros((n, 3)), w, valid, DT, None, ())


def _first_order(expected, keep, y):
    """Return a first-order response to ``setpoint`` that keeps the share ``keep`` of its distance per step and begins
    at ``y``.
    """
    return lfilter([1 - keep], [1, -keep], expected, zi=[keep * y])[0]


def _turns(phi):
    x, y, z = phi.T
    K = np.stack([0 * x, -z, y, z, 0 * x, -x, -y, x, 0 * x], axis=1).reshape(-1, 3, 3)
    return np.eye(3) + K + 0.5 * K @ K


TRUTHS = [
    {"delay": 0.03, "lag": 0.06, "rate_lag": (0.08, 0.08, 0.3), "gain": 0.9, "drag": (0.3, 0.3, 0.1)},
    {"delay": 0.0, "lag": 0.03, "rate_lag": (0.03, 0.03, 0.03), "gain": 1.1, "drag": (0.1, 0.4, 0.0)},
]


@pytest.fixture(scope="module")
def vehicles():
    """Return the identified vehicles; the first commands its thrust as a share of full thrust."""
    logs = [excited_flight(seed, **truth) for seed, truth in enumerate(TRUTHS)]
    logs[0] = dataclasses.replace(logs[0], full_thrust=25.0)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(identification, "DRAWS", DRAWS)
        return [identify(log) for log in logs]


@pytest.mark.parametrize("i", range(2))
def test_identification_recovers_parameters(vehicles, i):
    result, truth = vehicles[i], TRUTHS[i]
    assert result.delay.value == pytest.approx(truth["delay"], abs=0.003)
    assert result.thrust_lag.value == pytest.approx(truth["lag"], abs=0.004)
    assert result.thrust_gain.value == pytest.approx(truth["gain"], abs=0.01)
    assert result.rate_lag.value == pytest.approx(truth["rate_lag"][0], abs=0.004)
    assert result.yaw_lag.value == pytest.approx(truth["rate_lag"][2], rel=0.1)
    assert result.rate_gain.value == pytest.approx(1.0, abs=0.02)
    np.testing.assert_allclose([d.value for d in result.drag], truth["drag"], atol=0.02)
    for each in (result.delay, result.thrust_lag, result.thrust_gain, result.rate_lag, *result.drag):
        assert each.low <= each.value <= each.high
    gain = result.thrust_gain
    assert gain.low - 0.005 <= truth["gain"] <= gain.high + 0.005


def test_response_of_controller_to_noise_is_not_a_rate_loop():
    """At rest only noise moves, and the command responds to it, so that the next difference seems to follow at once."""
    rng, n = np.random.default_rng(0), TICKS
    tilt = 2e-3 * rng.normal(size=(n, 3))
    v = 6e-3 * rng.normal(size=(n, 3))
    R = Rotation.from_rotvec(tilt).as_matrix()
    command, c = -8.0 * tilt, 9.81 - 4.0 * v[:, 2]
    log = FlightLog(DT * np.arange(n), v * 0, R, v, v * 0, c, v * 0, command, np.ones(n, bool), DT, None, ())
    result = identify(log)
    assert result.delay is result.thrust_gain is result.rate_lag is result.yaw_lag is None
    assert result.drag == (None, None, None)


def test_thrust_is_identified_without_commanded_rates():
    truth = {"delay": 0.03, "lag": 0.06, "rate_lag": (0.05, 0.05, 0.2), "gain": 0.9, "drag": (0.3, 0.3, 0.1)}
    result = identify(dataclasses.replace(excited_flight(2, **truth), command=None))
    assert result.rate_lag is None
    assert result.thrust_gain.value == pytest.approx(0.9, abs=0.01)
    assert result.delay.value + result.thrust_lag.value == pytest.approx(0.09, abs=0.01)


def test_short_flight_is_refused():
    log = excited_flight(0, delay=0.0, lag=0.03, rate_lag=(0.03,) * 3, gain=1.0, drag=(0.0,) * 3, n=300)
    with pytest.raises(LogError, match="needs 8 s at least"):
        identify(log)


def test_identified_values_form_vehicle_file(vehicles):
    text = vehicle_toml(vehicles[0], "small", "a flight.csv")
    spec = validate(VehicleSpec, tomllib.loads(text), source="vehicle")
    assert spec.motor_tau == pytest.approx(0.06, abs=0.01)
    assert spec.rate_lag == pytest.approx((0.08, 0.08, 0.3), rel=0.1)
    assert spec.thrust_max == pytest.approx(0.9 * 25.0 * spec.mass, rel=0.05)
    assert spec.build().rate_lag is not None
    assert spec.command_delay == pytest.approx(0.03, abs=0.003)


@pytest.mark.parametrize(("delay", "lag"), [(0.0, 0.0), (0.02, 0.0), (0.013, 0.04), (0.05, 0.3)])
def test_acting_command_equals_fine_integration(delay, lag):
    rng, fine = np.random.default_rng(3), 400
    command = rng.normal(size=60)
    h, y, means = DT / fine, command[0], np.zeros(60)
    for i in range(60 * fine):
        k = max(0, i - round(delay / h)) // fine
        y = y + (command[k] - y) * (1 - np.exp(-h / lag)) if lag else command[k]
        means[i // fine] += y / fine
    np.testing.assert_allclose(acting_commands(command, DT, delay, lag)[5:], means[5:], atol=0.01)
