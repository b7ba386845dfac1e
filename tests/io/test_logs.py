"""A log in any units and frames gives the same flight; damage of every kind is reported and never crashes."""

import contextlib
import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fake_log import MAP, G, columns, fly_once, turned_frames, write_csv, write_map
from retrim.errors import ConfigError, LogError, RetrimError
from retrim.io.logs import read_flight_log, read_map
from retrim.io.logs.flight_part import ENDS
from retrim.io.logs.series import Series
from retrim.io.logs.times import in_order

FLIGHT = fly_once(12.0)


def read(tmp_path, table, text=MAP, **changes):
    path = write_csv(tmp_path / "log.csv", table)
    return read_flight_log(path, read_map(write_map(tmp_path / "map.toml", text, **changes)))


def assert_agrees(log, flight, places=1e-6):
    """Assert that the log equals the flight, except for the two ticks at each end that have no derivative."""
    assert len(log.t) == len(flight.t)
    for result, true in ((log.p, flight.p), (log.R, flight.R), (log.v, flight.v), (log.c, flight.c)):
        np.testing.assert_allclose(result, true, atol=places)
    np.testing.assert_allclose(log.command, flight.omega, atol=places)
    np.testing.assert_allclose(log.a[2:-2], flight.a[2:-2], atol=1e-3)
    assert log.valid[2:-2].all()


def test_plain_log_is_flight(tmp_path):
    log = read(tmp_path, columns(FLIGHT))
    assert_agrees(log, FLIGHT)
    assert log.dt == pytest.approx(0.02)
    assert log.notes == ()
    np.testing.assert_allclose(log.rates[1:-1], 0.5 * (FLIGHT.omega[1:-1] + FLIGHT.omega[:-2]), atol=0.05)


def in_other_units(table):
    q = Rotation.from_quat(np.stack([table[f"q{a}"] for a in "xyzw"], axis=1))
    changes = dict(table, t=1e6 * table["t"], c=table["c"] / 9.80665)
    changes |= {f"p{a}": 1000.0 * table[f"p{a}"] for a in "xyz"} | {f"v{a}": 3.6 * table[f"v{a}"] for a in "xyz"}
    changes |= {f"w{a}": np.degrees(table[f"w{a}"]) for a in "xyz"}
    angles = q.as_euler("ZYX", degrees=True)
    return changes | {"roll": angles[:, 2], "pitch": angles[:, 1], "yaw": angles[:, 0]}


def test_units_are_converted(tmp_path):
    log = read(
        tmp_path, in_other_units(columns(FLIGHT)), time__unit='"us"', position__unit='"mm"', velocity__unit='"km/h"',
        attitude__fields='["roll", "pitch", "yaw"]', attitude__form='"roll pitch yaw"', attitude__unit='"deg"',
        thrust__unit='"g"', rates__unit='"deg/s"',
    )  # fmt: skip
    assert_agrees(log, FLIGHT, 1e-5)


def test_frames_are_converted(tmp_path):
    log = read(tmp_path, columns(turned_frames(FLIGHT)), frames__world='"NED"', frames__body='"FRD"')
    assert_agrees(log, FLIGHT)


def test_velocities_in_body_axes_and_inverse_attitudes(tmp_path):
    body = np.einsum("nji,nj->ni", FLIGHT.R, FLIGHT.v)
    table = columns(dataclasses.replace(FLIGHT, v=body, R=np.swapaxes(FLIGHT.R, 1, 2)))
    assert_agrees(read(tmp_path, table, velocity__axes='"body"', attitude__turns='"world to body"'), FLIGHT)


def test_thrust_scale_is_estimated_or_given(tmp_path):
    table = columns(FLIGHT)
    table["c"] = -0.5 * table["c"] / G[2]
    result = read(tmp_path, table, thrust__unit='"share"', thrust__positive='"down"')
    assert result.full_thrust == pytest.approx(2 * G[2], rel=1e-3)
    np.testing.assert_allclose(result.c, FLIGHT.c, rtol=1e-3)
    message = read(tmp_path, table, thrust__unit='"share"', thrust__positive='"down"', thrust__hover="0.5")
    np.testing.assert_allclose(message.c, FLIGHT.c, rtol=1e-6)
    newton = columns(FLIGHT) | {"c": 1.3 * FLIGHT.c}
    np.testing.assert_allclose(read(tmp_path, newton, thrust__unit='"N"', thrust__mass="1.3").c, FLIGHT.c, rtol=1e-6)


def test_accelerometer_equals_derivative_of_velocity(tmp_path):
    specific_force = np.einsum("nji,nj->ni", FLIGHT.R, FLIGHT.a + G)
    table = columns(FLIGHT) | {f"f{a}": specific_force[:, i] for i, a in enumerate("xyz")}
    log = read(tmp_path, table, acceleration__fields='["fx", "fy", "fz"]')
    np.testing.assert_allclose(log.a, FLIGHT.a, atol=1e-5)


def test_fast_log_is_interpolated_and_slow_log_keeps_its_tick(tmp_path):
    fast = read(tmp_path, columns(fly_once(6.0, dt=0.004)))
    slow = fly_once(6.0, dt=0.02)
    assert fast.dt == 0.02
    np.testing.assert_allclose(fast.p[: len(slow.p)], slow.p, atol=1e-4)
    np.testing.assert_allclose(fast.R[: len(slow.p)], slow.R, atol=1e-4)
    rare = read(tmp_path, columns(fly_once(12.0, dt=0.05)))
    assert rare.dt == pytest.approx(0.05)


def test_missing_samples_are_excluded(tmp_path):
    table = {name: np.delete(x, np.s_[200:260]) for name, x in columns(FLIGHT).items()}
    table["px"][100] = np.nan
    log = read(tmp_path, table)
    assert any("1 of" in note and "not finite" in note for note in log.notes)
    assert any("gaps" in note for note in log.notes)
    inside = (log.t > 3.98) & (log.t < 5.18)
    assert not log.valid[inside].any()
    assert log.valid[(log.t > 0.1) & (log.t < 3.9)].mean() > 0.9
    np.testing.assert_allclose(log.p[log.valid], np.stack(
        [np.interp(log.t[log.valid], FLIGHT.t, FLIGHT.p[:, i]) for i in range(3)], axis=1), atol=1e-3)  # fmt: skip


def test_ages_shift_states_to_their_time(tmp_path):
    table = columns(FLIGHT) | {"age": np.full(len(FLIGHT.t), 0.04)}
    log = read(tmp_path, table, time__age='"age"')
    np.testing.assert_allclose(log.c[:100], FLIGHT.c[:100], atol=1e-6)
    np.testing.assert_allclose(log.p[:100], FLIGHT.p[2:102], atol=1e-6)


EPOCH = 1.7e9


def write_exact(path, table):
    """Write columns with all the digits that a time since 1970 needs."""
    rows = zip(*table.values(), strict=True)
    path.write_text("\n".join([",".join(table), *(",".join(repr(float(x)) for x in row) for row in rows)]))
    return path


@pytest.mark.parametrize("stamp", [0.0, EPOCH - 300.0, EPOCH + 900.0, 1.8e13, np.nan])
@pytest.mark.parametrize("place", [0, 1, 300, -1])
def test_sample_with_impossible_time_is_excluded(stamp, place, tmp_path):
    table = columns(FLIGHT) | {"t": EPOCH + FLIGHT.t}
    table["t"][place] = stamp
    log = read_flight_log(write_exact(tmp_path / "log.csv", table), read_map(write_map(tmp_path / "map.toml")))
    assert any("1 of 601 samples" in note for note in log.notes)
    assert log.valid.sum() > 585
    np.testing.assert_allclose(log.c[log.valid], np.interp(
        log.t[log.valid] + (0.02 * (place == 0)), FLIGHT.t, FLIGHT.c), atol=0.1)  # fmt: skip


@pytest.mark.parametrize("back", [0.01, 0.025, 0.4])
def test_commands_out_of_order_are_excluded(back, tmp_path):
    """Two threads stamp the commands; the previous command is held in place of a late one."""
    series = Series(EPOCH + FLIGHT.t.copy(), FLIGHT.c[:, None])
    series.t[7::50] -= back
    result, notes = in_order(series, "thrust", Path("log"))
    assert notes == ["thrust: 12 of 601 samples are not newer than the one before, and are left out"] or back == 0.01
    assert np.all(np.diff(result.t) > 0.0)
    assert len(result.t) == 601 - (12 if back > 0.02 else 0)


def test_backward_times_are_reported_relative_to_start():
    t = EPOCH + np.concatenate([FLIGHT.t, FLIGHT.t])
    with pytest.raises(LogError, match=r"goes back 1 times, first by 12\.000 s, 12\.000 s after the beginning"):
        in_order(Series(t, np.ones((len(t), 1))), "thrust", Path("log"))


@pytest.mark.parametrize("dt", [0.096, 0.1016, 0.104])
def test_ten_samples_per_second_suffice(dt, tmp_path):
    log = read(tmp_path, columns(fly_once(40.0, dt=dt)))
    assert log.dt == pytest.approx(dt, rel=1e-3)
    assert log.seconds > 39.0


WINDY = fly_once(12.0, wind=(6.0, -2.0, 1.0))
"""Pushed so hard that it does not accelerate along its thrust axis: every other map is tried, and none is better."""


@pytest.mark.parametrize(
    ("factor", "changes"),
    [
        (1.0, {}),
        (0.45 / G[2], {"thrust__unit": '"share"', "thrust__hover": "0.45"}),
        (0.45 / G[2], {"thrust__unit": '"share"'}),
        (1.3, {"thrust__unit": '"N"', "thrust__mass": "1.3"}),
        (1.0 / 9.80665, {"thrust__unit": '"g"'}),
    ],
)
def test_strong_wind_is_not_a_map_error(factor, changes, tmp_path):
    table = columns(WINDY) | {"c": factor * WINDY.c}
    log = read(tmp_path, table, **changes)
    assert log.valid[2:-2].all()


@pytest.mark.parametrize("form", ["matrix", "roll pitch yaw"])
def test_strong_wind_is_not_an_attitude_error(form, tmp_path):
    attitudes, table = Rotation.from_matrix(WINDY.R), columns(WINDY)
    values = WINDY.R.reshape(-1, 9) if form == "matrix" else attitudes.as_euler("ZYX")[:, ::-1]
    table |= {f"r{i}": values[:, i] for i in range(values.shape[1])}
    fields = str([f"r{i}" for i in range(values.shape[1])]).replace("'", '"')
    log = read(
        tmp_path,
        table,
        attitude__fields=fields,
        attitude__form=f'"{form}"',
        measured_rates__fields='["wx", "wy", "wz"]',
    )
    np.testing.assert_allclose(log.R, WINDY.R, atol=1e-6)


# ---- damage


def modify(name, change):
    def modified_log(table):
        return table | {name: change(table[name].copy())}

    return modified_log


def with_nan(x):
    x[:] = np.nan
    return x


def back(x):
    x[300:] -= 4.0
    return x


def negate(*names):
    return lambda table: table | {name: -table[name] for name in names}


def scale(factor, *names):
    return lambda table: table | {name: factor * table[name] for name in names}


def swap(table):
    return table | {"qx": table["qw"], "qy": table["qx"], "qz": table["qy"], "qw": table["qz"]}


def inverse(table):
    return negate("qx", "qy", "qz")(table)


def in_body_axes(table):
    body = np.einsum("nji,nj->ni", FLIGHT.R, FLIGHT.v)
    return table | {f"v{a}": body[:, i] for i, a in enumerate("xyz")}


def at_rest(table):
    return table | {name: np.full_like(table[name], table[name][0]) for name in ("px", "py", "pz")}


def other_time(table):
    rng = np.random.default_rng(0)
    order = rng.permutation(len(table["px"]))
    return table | {name: table[name][order] for name in ("px", "py", "pz")}


def ned(table):
    return columns(turned_frames(FLIGHT))


def frd(table):
    turned_flight = turned_frames(FLIGHT)
    return columns(dataclasses.replace(FLIGHT, R=FLIGHT.R @ np.diag([1.0, -1.0, -1.0]), omega=turned_flight.omega))


DAMAGED_TABLES = {
    "no column": (lambda table: {n: x for n, x in table.items() if n != "pz"}, "no field 'pz'; there are t, px"),
    "no finite sample": (modify("vx", with_nan), "velocity has no finite sample"),
    "constant time": (modify("t", lambda t: 0 * t), "all at one time"),
    "time goes back": (modify("t", back), "goes back 1 times.*several flights"),
    "time in ms": (scale(1000.0, "t"), "every 20 s.*is time in ms"),
    "time too fine": (scale(1e-6, "t"), "is time in ms, us or ns"),
    "two flights": (
        modify("t", lambda t: np.concatenate([t[:300], t[: len(t) - 300]])),
        "back 1 times, first by 5.980 s",
    ),
    "too short": (lambda table: {n: x[:20] for n, x in table.items()}, "of flight are left, at least 1 s"),
    "one sample": (lambda table: {n: x[:1] for n, x in table.items()}, "1 samples, all at one time"),
    "too rare": (lambda table: {n: x[::20] for n, x in table.items()}, "every 0.4 s; accelerations need"),
    "slower than any tick": (
        lambda table: columns(fly_once(12.0, dt=0.105)),
        "every 0.105 s; accelerations need.* 0.1 s",
    ),
    "quaternions not of norm one": (scale(0.7, "qx", "qy", "qz", "qw"), "not of norm one"),
    "quaternions in another order": (swap, 'with attitude.form = "wxyz" they would'),
    "inverse attitudes": (inverse, 'attitude.turns = "world to body" they would'),
    "NED and FRD": (ned, 'frames.world = "NED" and frames.body = "FRD"'),
    "FRD": (frd, 'frames.body = "FRD" they would'),
    "velocity in body axes": (in_body_axes, 'velocity.axes = "body" they would'),
    "velocity in km/h": (scale(3.6, "vx", "vy", "vz"), 'velocity.unit = "km/h" they would'),
    "position in mm": (scale(1000.0, "px", "py", "pz"), "position.*units"),
    "rates in deg/s": (scale(57.3, "wx", "wy", "wz"), 'rates.unit = "deg/s" they would'),
    "rates against": (negate("wx", "wy", "wz"), "does not turn as commanded"),
    "thrust downwards": (negate("c"), 'thrust is never above zero.*positive = "down"'),
    "thrust in g": (scale(1 / 9.80665, "c"), 'thrust.unit = "g" they would'),
    "zero thrust": (scale(0.0, "c"), "thrust is 0 throughout; thrust.fields must name"),
    "position does not change": (at_rest, "position"),
    "shifted positions": (other_time, "position"),
}


@pytest.mark.parametrize("kind", DAMAGED_TABLES)
def test_damaged_tables_are_refused(kind, tmp_path):
    damage, text = DAMAGED_TABLES[kind]
    with pytest.raises(LogError, match=f"(?s)log.csv.*{text}") as error:
        read(tmp_path, damage(columns(FLIGHT)))
    assert "\n" not in str(error.value)


WHOLE = None


def text_of(tmp_path):
    return write_csv(tmp_path / "whole.csv", columns(fly_once(3.0))).read_text()


def cut_line(text, number, line):
    lines = text.splitlines()
    lines[number] = line
    return "\n".join(lines)


DAMAGED_FILES = {
    "empty": (lambda text: "", "it is empty"),
    "header only": (lambda text: text.splitlines()[0] + "\n", "a header and no sample"),
    "no header": (lambda text: "\n".join(text.splitlines()[1:]), "first line must name the columns"),
    "a word": (lambda text: cut_line(text, 7, "0.1,oops" + ",0" * 13), "line 8, column 'px': 'oops' is not a number"),
    "a short line": (lambda text: cut_line(text, 7, "0.1,0,0"), "line 8: 3 cells, but the header has 15"),
    "a duplicate column": (lambda text: text.replace("px,py", "px,px"), "two columns are named 'px'"),
    "an open list": (lambda text: cut_line(text, 3, "0.1,[1" + ",0" * 13), "is not a number"),
    "a huge integer in a list": (
        lambda text: cut_line(text, 7, f"0.1,[{10**400}]" + ",0" * 13), "line 8, column 'px': .* is not a number"
    ),
    "only a torn line": (lambda text: text.splitlines()[0] + "\n0.1,0,0", "a header and no whole sample"),
    "blanks only": (lambda text: "\n \n\n", "."),
}  # fmt: skip


@pytest.mark.parametrize("kind", DAMAGED_FILES)
def test_damaged_files_are_refused(kind, tmp_path):
    damage, text = DAMAGED_FILES[kind]
    path = tmp_path / "log.csv"
    path.write_text(damage(text_of(tmp_path)))
    with pytest.raises(LogError, match=text):
        read_flight_log(path, read_map(write_map(tmp_path / "map.toml")))


def test_incomplete_last_line_is_excluded(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text(text_of(tmp_path)[:-30])
    log = read_flight_log(path, read_map(write_map(tmp_path / "map.toml")))
    assert any("torn" in note for note in log.notes)


def test_jumping_or_frozen_positions_are_excluded(tmp_path):
    table = columns(FLIGHT)
    table["px"][200:] += 3.0
    for name in ("px", "py", "pz"):
        table[name][400:430] = table[name][400]
    log = read(tmp_path, table)
    assert any("jumps 1 times" in note or "jumps 2 times" in note for note in log.notes)
    assert any("does not change" in note for note in log.notes)
    assert not log.valid[[200, 415]].any()
    assert log.valid.mean() > 0.9


def test_time_on_ground_is_excluded(tmp_path):
    n, table = 200, columns(FLIGHT)
    before = {name: np.full(n, x[0]) for name, x in table.items()}
    before |= {"t": 0.02 * np.arange(-n, 0), "c": np.zeros(n)} | {f"v{a}": np.zeros(n) for a in "xyz"}
    whole = {name: np.concatenate([before[name], x]) for name, x in table.items()}
    whole["px"] += 1e-9 * np.arange(len(whole["px"]))
    log = read(tmp_path, whole)
    assert any("on the ground" in note for note in log.notes)
    assert not log.valid[: n - 50].any()
    assert log.valid[n + 50 : -ENDS].all()


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"position__unit": '"furlong"'}, "position.unit"),
        ({"position__feilds": '["x"]'}, "unknown key; did you mean 'fields'"),
        ({"thrust__unit": '"N"'}, "mass .* goes with"),
        ({"thrust__hover": "0.5"}, "hover goes with"),
        ({"attitude__form": '"euler"'}, "attitude.form"),
        ({"part__start": "5.0", "part__end": "4.0"}, "part.end = 4.0 s must be after"),
        ({"altitude__fields": '["z"]'}, "unknown key; "),
    ],
)
def test_wrong_maps_are_refused(change, text, tmp_path):
    with pytest.raises(ConfigError, match=text):
        read_map(write_map(tmp_path / "map.toml", **change))


def test_other_files_are_refused(tmp_path):
    for name, data, text in (
        ("log.xyz", b"1", "unknown kind of log"),
        ("log.npz", b"PK junk", "not a whole NPZ"),
        ("log.csv", bytes(range(256)), "not a text file|no field|header"),
        ("log.ulg", b"ULog junk", "ULog"),
        ("log.mcap", b"\x89MCAP0\r\n junk", "bag"),
        ("log.bag", b"#ROSBAG V2.0\n junk", "bag"),
        ("log.db3", b"SQLite format 3\x00", "bag"),
    ):
        path = tmp_path / name
        path.write_bytes(data)
        names = "retrim-mcap" if "bag" in text else "px4" if name == "log.ulg" else "retrim-npz"
        with pytest.raises(LogError, match=text):
            read_flight_log(path, read_map(names))
    path = write_csv(tmp_path / "log.csv", columns(fly_once(2.0)))
    with pytest.raises(
        LogError, match=r"no field 'x0'.*without a map it is read as 'retrim-csv' or 'crazyflie'.*: give --map"
    ):
        read_flight_log(path)
    with pytest.raises(LogError, match="no such file"):
        read_flight_log(tmp_path / "nowhere.csv")
    (tmp_path / "log.txt").write_text("t\n1\n")
    with pytest.raises(LogError, match=r"describe its fields.* maps by name: ardupilot, "):
        read_flight_log(tmp_path / "log.txt")
    for name, text in (("a.LOG", "mavlogdump.py"), ("a.tlog", "mavlogdump.py"), ("a.px4log", "sdlog2_dump.py")):
        (tmp_path / name).write_bytes(b"1")
        with pytest.raises(LogError, match=rf"is not read; {text} .* makes a CSV.*--map map.toml"):
            read_flight_log(tmp_path / name)
    with pytest.raises(LogError, match="cannot be read as a bag"):
        read_flight_log(tmp_path)
    with pytest.raises(LogError, match="cannot be read as a bag"):
        read_flight_log(tmp_path, read_map("retrim-mcap"))


def test_random_bytes_give_one_line(tmp_path):
    """Random bytes in any format give one line and no other error."""
    rng, choice = np.random.default_rng(0), read_map(write_map(tmp_path / "map.toml"))
    whole = text_of(tmp_path).encode()
    for k in range(60):
        data = bytearray(whole)
        for place in rng.integers(0, len(data), 5):
            data[place] = rng.integers(0, 256)
        path = tmp_path / f"log{['.csv', '.npz', '.ulg', '.mcap', '.bag', '.db3'][k % 6 if k > 30 else 0]}"
        path.write_bytes(bytes(data[: rng.integers(1, len(data))]))
        with contextlib.suppress(RetrimError):
            log = read_flight_log(path, choice)
            assert np.isfinite(np.concatenate([log.p, log.v, log.c[:, None]], axis=1)).all()


DAMAGED = (0.0, np.nan, np.inf, 1e308, -1e308, 1e-308, 1e30, -1.0, 1e9)


@pytest.mark.parametrize("missing", ["nothing", "velocity", "position"])
def test_damaged_numbers_give_one_line_or_finite_flight(missing, tmp_path):
    """Any number in any column may be damaged once, for an interval, or throughout."""
    rng, short = np.random.default_rng(1), columns(fly_once(3.0))
    text = MAP if missing == "nothing" else re.sub(rf"\[{missing}\]\n.*\n", "", MAP)
    maps = [read_map(write_map(tmp_path / "map.toml", text, thrust__unit=unit)) for unit in ('"m/s^2"', '"share"')]
    for k in range(24):
        table = {name: x.copy() for name, x in short.items()}
        for name in rng.choice(list(table), 2):
            first = rng.integers(0, len(table["t"]))
            table[name][first : first + rng.choice([1, 30, 500])] = rng.choice(DAMAGED)
        path = write_csv(tmp_path / "log.csv", table)
        message = ""
        try:
            log = read_flight_log(path, maps[k % 2])
        except RetrimError as error:
            message = str(error)
        assert "\n" not in message
        assert len(message) < 1000
        for column in () if message else (log.p, log.v, log.a, log.R, log.rates, log.c):
            assert np.isfinite(column[log.valid]).all()
