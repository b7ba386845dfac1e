"""Logs with poses only, or with velocities only."""

import numpy as np
import pytest

from fake_log import MAP, columns, fly_once, turned_frames, write_csv, write_map
from retrim.errors import ConfigError, LogError
from retrim.io.logs import read_flight_log, read_map
from retrim.io.logs.series import Series
from retrim.io.logs.smoothing import slope_of
from retrim.replay import rows_of

PUSH = (0.4, -0.3, 0.1)
POSES = MAP.replace('[velocity]\nfields = ["vx", "vy", "vz"]\n', "")
SPEEDS = MAP.replace('[position]\nfields = ["px", "py", "pz"]\n', "")


def read(tmp_path, table, text, **changes):
    path = write_csv(tmp_path / "log.csv", table)
    return read_flight_log(path, read_map(write_map(tmp_path / "map.toml", text, **changes)))


def residual_errors(log):
    return np.asarray(rows_of(log).a_res)[log.valid] - PUSH


@pytest.mark.parametrize(("dt", "noise", "rms"), [(0.02, 0.0, 0.01), (0.01, 5e-4, 0.4), (0.004, 5e-4, 0.4)])
def test_velocities_are_derivative_of_positions(dt, noise, rms, tmp_path):
    """The velocity is exact without noise.

    With noise of motion capture it has no lag, and the mean residual is the push.
    """
    flight = fly_once(12.0, dt=dt, wind=PUSH)
    table = columns(flight)
    rng = np.random.default_rng(0)
    for name in ("px", "py", "pz"):
        table[name] = table[name] + noise * rng.normal(size=len(flight.t))
    log = read(tmp_path, table, POSES)
    assert np.sqrt(np.mean(residual_errors(log) ** 2)) < rms
    np.testing.assert_allclose(residual_errors(log).mean(axis=0), 0.0, atol=0.02)
    (note,) = [note for note in log.notes if "derivative" in note]
    assert "centred, without a lag; its noise is about" in note
    assert "motion" not in log.agreement


@pytest.mark.parametrize("sigma", [1e-4, 1e-3])
def test_stated_noise_is_that_of_derivative(sigma, tmp_path):
    t = 0.01 * np.arange(4000)
    p = np.stack([np.sin(t), np.cos(t), 0 * t], axis=1) + sigma * np.random.default_rng(0).normal(size=(4000, 3))
    v, note = slope_of(tmp_path, Series(t, p), 1.0)
    true = np.stack([np.cos(v.t), -np.sin(v.t), 0 * v.t], axis=1)
    message = float(note.split("about ")[1].split(" m/s")[0])
    assert message == pytest.approx(np.std(v.values - true), rel=0.1)
    assert message < 0.02


def test_positions_in_millimetres_and_other_frames(tmp_path):
    ned = turned_frames(fly_once(8.0, wind=PUSH))
    table = columns(ned)
    for name in ("px", "py", "pz"):
        table[name] = 1000.0 * table[name]
    log = read(tmp_path, table, POSES, position__unit='"mm"', frames__world='"NED"', frames__body='"FRD"')
    np.testing.assert_allclose(residual_errors(log), 0.0, atol=0.03)
    with pytest.raises(LogError, match=r'with position.unit = "mm" they would'):
        read(tmp_path, table, POSES, frames__world='"NED"', frames__body='"FRD"')


def test_time_jitter_and_missing_poses(tmp_path):
    """Each cubic uses its own times; ticks near missing poses are invalid."""
    flight = fly_once(12.0, dt=0.01, wind=PUSH)
    k = np.arange(len(flight.t))
    rest = (k % 7 != 3) & ~((k > 500) & (k < 540))
    log = read(tmp_path, {name: x[rest] for name, x in columns(flight).items()}, POSES)
    np.testing.assert_allclose(residual_errors(log), 0.0, atol=0.1)
    inside = (log.t > 5.0) & (log.t < 5.3)
    assert not log.valid[inside].any()
    assert log.valid[~((log.t > 4.8) & (log.t < 5.6))][5:-5].all()


@pytest.mark.parametrize("dt", [0.02, 0.005])
def test_position_jumps_have_no_velocity(dt, tmp_path):
    """Motion capture that swaps two markers jumps for several samples or for one."""
    flight = fly_once(12.0, dt=dt, wind=PUSH)
    table = columns(flight)
    table["py"] = table["py"] + 0.15 * ((flight.t > 5.0) & (flight.t < 6.0))
    table["px"][round(8.0 / dt)] += 0.3
    log = read(tmp_path, table, POSES)
    np.testing.assert_allclose(residual_errors(log), 0.0, atol=0.1)
    assert log.seconds > 11.0
    assert any("the position jumps 4 times, and the ticks around are left out" in note for note in log.notes)


@pytest.mark.parametrize("axes", ["world", "body"])
def test_velocities_only(axes, tmp_path):
    flight = fly_once(8.0, wind=PUSH)
    table = columns(flight)
    if axes == "body":
        body = np.einsum("nji,nj->ni", flight.R, flight.v)
        table |= {f"v{axis}": body[:, i] for i, axis in enumerate("xyz")}
    log = read(tmp_path, table, SPEEDS, velocity__axes=f'"{axes}"')
    np.testing.assert_allclose(residual_errors(log), 0.0, atol=5e-3)
    np.testing.assert_allclose(log.p - log.p[0], flight.p - flight.p[0], atol=2e-3)
    assert "positions are the integral of the velocities" in log.notes


def test_log_without_poses_and_velocities_is_refused(tmp_path):
    with pytest.raises(ConfigError, match=r"\[position\], \[velocity\] or both must be there"):
        read_map(write_map(tmp_path / "map.toml", POSES.replace('[position]\nfields = ["px", "py", "pz"]\n', "")))
