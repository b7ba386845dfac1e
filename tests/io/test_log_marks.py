"""Resets, ground contact and invalid estimates are read from the autopilot's marks, or detected without marks."""

import dataclasses

import numpy as np
import pytest

from fake_bytes import px4_topics, ulog
from fake_log import G, columns, fly_once, write_csv, write_map
from retrim.errors import LogError
from retrim.io.logs import read_flight_log, read_map
from retrim.replay import rows_of

FLIGHT = fly_once(16.0)


def residual_errors(log):
    """Return the root mean square and the largest error of the residual, whose true value is zero."""
    wrong = np.abs(np.asarray(rows_of(log).a_res)[log.valid])
    return float(np.sqrt(np.mean(wrong**2))), float(wrong.max())


def read_ulog(tmp_path, topics, stamps):
    pytest.importorskip("pyulog")
    (tmp_path / "flight.ulg").write_bytes(ulog(topics, stamps))
    return read_flight_log(tmp_path / "flight.ulg")


def test_samples_marked_invalid_by_px4_are_excluded(tmp_path):
    topics, stamps = px4_topics(FLIGHT)
    place = topics["vehicle_local_position"]
    holds = np.ones(len(stamps))
    holds[200:500] = 0.0
    for name in ("vx", "vy"):
        place[name] = ("float", np.where(holds > 0, place[name][1], 0.0))
    place |= {"v_xy_valid": ("bool", holds), "xy_valid": ("bool", 0 * holds + 1)}
    log = read_ulog(tmp_path, topics, stamps)
    assert "velocity was not valid for 6.0 s, which are left out" in log.notes
    assert not any("jumps" in note for note in log.notes)
    assert residual_errors(log)[1] < 0.03
    assert log.seconds == pytest.approx(10.0, abs=0.3)
    assert log.full_thrust == pytest.approx(2.0 * G[2], rel=0.05)


def test_velocity_that_is_never_valid_is_reported(tmp_path):
    topics, stamps = px4_topics(FLIGHT)
    topics["vehicle_local_position"]["v_z_valid"] = ("bool", np.zeros(len(stamps)))
    with pytest.raises(LogError, match=r"0.00 s of flight are left.*velocity was not valid for 16.0 s"):
        read_ulog(tmp_path, topics, stamps)


@pytest.mark.parametrize("counter", [True, False])
@pytest.mark.parametrize("step", [0.12, 0.8])
def test_velocity_resets_are_excluded(counter, step, tmp_path):
    """With a counter, any reset is found; without one, a reset beyond the acceleration of a vehicle is found."""
    topics, stamps = px4_topics(FLIGHT)
    place = topics["vehicle_local_position"]
    off = (FLIGHT.t > 6.0) & (FLIGHT.t < 6.5)
    place["vx"] = ("float", place["vx"][1] + step * off)
    if counter:
        place["vxy_reset_counter"] = ("uint8_t", 254 + np.cumsum(np.abs(np.diff(off, prepend=False))) & 255)
    log = read_ulog(tmp_path, topics, stamps)
    (note,) = [note for note in log.notes if "jumps" in note]
    assert f"velocity jumps 2 times ({2 * counter} resets by its counter)" in note
    assert residual_errors(log)[1] < 0.03
    assert log.seconds > 15.5


def test_isolated_wrong_velocities_are_excluded(tmp_path):
    """Motion capture that swaps two markers reports such velocities."""
    table = columns(FLIGHT)
    table["vy"][100::50] += 1.5
    path = write_csv(tmp_path / "log.csv", table)
    log = read_flight_log(path, read_map(write_map(tmp_path / "map.toml")))
    assert residual_errors(log)[1] < 0.05
    assert log.seconds > 11.0


def test_heading_reset_is_excluded(tmp_path):
    topics, stamps = px4_topics(FLIGHT)
    q = topics["vehicle_attitude"]["q"][1].copy()
    half = 0.15  # rad; half of the step
    turn = np.array([np.cos(half), 0.0, 0.0, np.sin(half)])
    w, x, y, z = q[400:].T
    q[400:] = np.stack([turn[0] * w - turn[3] * z, turn[0] * x - turn[3] * y, turn[0] * y + turn[3] * x,
                        turn[0] * z + turn[3] * w], axis=1)  # fmt: skip
    topics["vehicle_attitude"]["q"] = ("float[4]", q)
    log = read_ulog(tmp_path, topics, stamps)
    assert any("attitude jumps 1 times" in note for note in log.notes)
    assert not log.valid[399:402].any()


def with_ground(flight, seconds, lift):
    """Return a flight with time on the ground before and after it, at a fraction of the hover thrust."""
    n = round(seconds / 0.02)

    def around(x, first, last):
        return np.concatenate([np.repeat(first[None], n, axis=0), x, np.repeat(last[None], n, axis=0)])

    still = np.zeros(3)
    ramp = np.linspace(0.0, lift, n) * G[2]
    return dataclasses.replace(
        flight,
        t=0.02 * np.arange(len(flight.t) + 2 * n),
        p=around(flight.p, flight.p[0], flight.p[-1]) + 1e-4 * np.random.default_rng(0).normal(
            size=(len(flight.t) + 2 * n, 3)),
        R=around(flight.R, flight.R[0], flight.R[-1]),
        v=around(flight.v, still, still),
        omega=around(flight.omega, still, still),
        c=np.concatenate([ramp, flight.c, np.full(n, 0.6 * lift * G[2])]),
    )  # fmt: skip


@pytest.mark.parametrize("unit", ["m/s^2", "share"])
@pytest.mark.parametrize("lift", [0.95, 0.6, 0.4])
def test_time_on_ground_is_not_flight(unit, lift, tmp_path):
    """The propellers spin on the ground, and the thrust scale is estimated from the flight only."""
    whole, n = with_ground(FLIGHT, 4.0, lift), 200
    table = columns(whole)
    table["c"] = table["c"] * (0.5 / G[2] if unit == "share" else 1.0)
    for name in ("vx", "vy", "vz"):
        for k in (n, len(table["t"]) - n):
            table[name][k - 3 : k + 3] = np.nan  # take-off and landing at speed are excluded from this test
    log = read_flight_log(
        write_csv(tmp_path / "log.csv", table), read_map(write_map(tmp_path / "m.toml", thrust__unit=f'"{unit}"'))
    )
    assert log.valid[: n - 3].sum() + log.valid[-n + 3 :].sum() == 0
    assert log.valid[n + 10 : -n - 10].mean() > 0.97
    assert any("on the ground are left out" in note for note in log.notes)
    assert residual_errors(log)[0] < (0.05 if unit == "m/s^2" else 0.4)
    if unit == "share":
        assert G[2] / log.full_thrust == pytest.approx(0.5, rel=0.04)


@pytest.mark.parametrize("value", [1e3, 1e12, -1e4])
def test_few_damaged_thrusts_do_not_decide_about_ground(value, tmp_path):
    """The rest of the flight stays a flight, and the time on the ground stays on the ground."""
    table = columns(with_ground(fly_once(8.0), 2.0, 0.4))
    plan = read_map(write_map(tmp_path / "m.toml"))
    intact = read_flight_log(write_csv(tmp_path / "intact.csv", table), plan)
    table["c"][300:305] = value
    log = read_flight_log(write_csv(tmp_path / "damaged.csv", table), plan)
    np.testing.assert_array_equal(log.valid, intact.valid)


def test_hover_is_not_ground(tmp_path):
    """At rest in the air the thrust equals that of hover for any thrust scale."""
    n = 800
    level = dataclasses.replace(
        FLIGHT,
        t=0.02 * np.arange(n),
        p=np.tile([0.0, 0.0, 1.0], (n, 1)) + 1e-3 * np.random.default_rng(1).normal(size=(n, 3)),
        R=np.tile(np.eye(3), (n, 1, 1)),
        v=1e-3 * np.random.default_rng(2).normal(size=(n, 3)),
        c=np.full(n, 7.5),  # a thrust map that is wrong by a quarter
        omega=np.zeros((n, 3)),
    )
    path = write_csv(tmp_path / "log.csv", columns(level))
    log = read_flight_log(path, read_map(write_map(tmp_path / "m.toml")))
    assert log.valid[3:-3].mean() > 0.98


def test_land_detector_is_used(tmp_path):
    topics, stamps = px4_topics(FLIGHT)
    topics["vehicle_land_detected"] = {"landed": ("bool", np.array([1, 0, 1]))}
    slow = dict.fromkeys(topics, stamps) | {"vehicle_land_detected": stamps[[0, 100, 700]]}
    log = read_ulog(tmp_path, topics, slow)
    assert any("on the ground (its land detector says 4.0 s) are left out" in note for note in log.notes)
    assert not log.valid[:99].any()
    assert not log.valid[701:].any()
    assert log.valid[110:690].all()
    topics["vehicle_land_detected"] = {"landed": ("bool", np.array([0]))}
    log = read_ulog(tmp_path, topics, slow | {"vehicle_land_detected": stamps[[300]]})
    assert log.valid[3:-3].all()


def test_position_that_is_never_valid_is_not_used(tmp_path):
    """A flight without GPS has a valid velocity, and the residual does not need the position."""
    topics, stamps = px4_topics(FLIGHT)
    place = topics["vehicle_local_position"]
    place |= {"xy_valid": ("bool", np.zeros(len(stamps))), "v_xy_valid": ("bool", np.ones(len(stamps)))}
    for name in "xyz":
        place[name] = ("float", np.zeros(len(stamps)))
    log = read_ulog(tmp_path, topics, stamps)
    assert "position is never valid, and is not used" in log.notes
    assert residual_errors(log)[1] < 0.03
    assert log.valid[3:-3].all()


def test_marks_can_be_compared_with_number(tmp_path):
    """Examples are a state that is 1 on the ground, and a fix that is 3 if valid."""
    t = FLIGHT.t
    table = columns(FLIGHT) | {"state": np.where(t < 3.0, 1.0, 2.0), "fix": np.where((t > 8.0) & (t < 10.0), 1.0, 3.0)}
    table["vx"] = np.where((t > 8.0) & (t < 10.0), 0.0, table["vx"])
    choice = write_map(tmp_path / "map.toml", landed__fields='["state==1"]', velocity__valid='["fix==3"]')
    log = read_flight_log(write_csv(tmp_path / "log.csv", table), read_map(choice))
    assert not log.valid[log.t < 2.9].any()
    assert not log.valid[(log.t > 7.99) & (log.t < 9.99)].any()
    assert log.valid[((log.t > 3.1) & (log.t < 7.9)) | ((log.t > 10.1) & (log.t < 15.9))].all()
    assert "velocity was not valid for 2.0 s, which are left out" in log.notes
    assert residual_errors(log)[1] < 0.03


def test_missing_marks_are_ignored(tmp_path):
    choice = write_map(
        tmp_path / "map.toml", landed__fields='["ground"]', velocity__valid='["ok"]', attitude__resets='["n"]'
    )
    log = read_flight_log(write_csv(tmp_path / "log.csv", columns(FLIGHT)), read_map(choice))
    assert log.valid[3:-3].all()
