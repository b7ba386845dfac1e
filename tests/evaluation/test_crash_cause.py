"""The reported cause of a crash is the fault of the simulated plant, with its size."""

import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from retrim.evaluation.crash_cause import body_rates, likely_cause
from retrim.runtime.flight import Log, States

DT, G = 0.02, 9.80665


def fly_once(*, n=100, delay=1, lag=0.03, sign=1.0, ringing=None, thrust=1.0, down=False, velocity=1.0, seed=0):
    """Return the log of a point that turns and accelerates as commanded, except for its faults."""
    rng = np.random.default_rng(seed)
    knots = rng.normal(size=(n // 10 + 2, 4)) * np.array([1.5, 1.2, 1.2, 0.3])
    u = np.array([[np.interp(k / 10, np.arange(len(knots)), knots[:, i]) for i in range(4)] for k in range(n + 1)])
    u[:, 0] += G
    u[0] = (G, 0.0, 0.0, 0.0)
    R, p, v = Rotation.identity(), np.zeros(3), np.zeros(3)
    w, dw = np.zeros(3), np.zeros(3)
    rows = [(p, R.as_matrix(), v)]
    for k in range(1, n + 1):
        expected = sign * u[max(0, k - delay), 1:]
        for _ in range(20):
            h = DT / 20
            if ringing is None:
                w = w + h / lag * (expected - w)
            else:
                dw = dw + h * (ringing**2 * (expected - w) - 2.0 * 0.05 * ringing * dw)
                w = w + h * dw
            R = R * Rotation.from_rotvec(h * w)
            a = thrust * u[k, 0] * R.as_matrix()[:, 2] - np.array([0.0, 0.0, G])
            p, v = p + h * v, v + h * a
        rows.append((p, R.as_matrix(), v))
    p, R, v = (np.array(part) for part in zip(*rows, strict=True))
    if down:
        flip = np.diag([1.0, -1.0, -1.0])
        p, v, R = p @ flip, v @ flip, flip @ R @ flip
    return Log(DT * np.arange(n + 1), States(p, R, v), States(p, R, velocity * v), u, DT, True)


def test_vehicle_without_fault_has_no_cause():
    for seed in range(5):
        assert likely_cause(fly_once(seed=seed), 0.05) is None


@pytest.mark.parametrize(
    ("fault", "text"),
    [
        ({"delay": 8}, r"turned with .* 0\.(1[5-9]|2\d) s later, and the policy was trained for 0\.05 s.* rate_lag"),
        ({"lag": 0.3}, r"0\.[23]\d s later, and the policy was trained for 0\.05 s: give its rate_lag"),
        ({"ringing": 12.0}, r"(its rate loop oscillates|give its rate_lag)"),
        ({"sign": -1.0}, r"turns against its command .* signs of roll and pitch"),
        ({"thrust": 0.5}, r"the thrust is 0\.5\d times what is commanded|the thrust is 0\.4\d times"),
        ({"thrust": 2.0}, r"the thrust is (1\.9\d|2\.0\d) times what is commanded"),
        ({"down": True}, r"vertical acceleration is -\d\.\d+ times what is commanded: .* \(NED\)"),
        ({"velocity": 0.5}, r"the velocity is 0\.5\d? times the derivative"),
    ],
)  # fmt: skip
def test_fault_is_reported_with_size(fault, text):
    for seed in range(3):
        result = likely_cause(fly_once(seed=seed, **fault), 0.05)
        assert result is not None
        np.testing.assert_string_equal(result, " ".join(result.split()))  # one line
        assert re.search(text, result), result


def test_numbers_clock_and_rotation():
    log = fly_once()
    assert "clock does not advance" in likely_cause(log._replace(t=0.0 * log.t), 0.05)
    assert "measurements are 0.06 s apart" in likely_cause(log._replace(t=3.0 * log.t), 0.05)
    spoilt = log.measured.v.copy()
    spoilt[60:] = np.nan
    assert "velocity: not a number from 1.20 s on" in likely_cause(
        log._replace(measured=log.measured._replace(v=spoilt)), 0.05
    )
    wide = log._replace(measured=log.measured._replace(R=1.2 * log.measured.R))
    assert "the attitude is not a rotation: R' R differs from 1 by 0.44" in likely_cause(wide, 0.05)


def test_body_rates_follow_from_attitudes():
    w = np.array([0.4, -2.0, 1.1])
    R = np.array([Rotation.from_rotvec(DT * k * w).as_matrix() for k in range(5)])
    np.testing.assert_allclose(body_rates(R, DT), np.tile(w, (4, 1)), rtol=1e-9)
