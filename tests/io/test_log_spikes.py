"""Single damaged samples of commands and sensors are left out and counted; intended commands remain."""

import dataclasses

import numpy as np
import pytest

from fake_body_flight import fly_body
from fake_dataflash import body_messages, dataflash
from fake_log import MAP, columns, fly_once, write_csv, write_map
from retrim.io.logs import read_flight_log, read_log, read_map
from retrim.io.logs.log_map import BodyRates
from retrim.io.logs.quantities import read_quantities
from retrim.io.logs.series import Series
from retrim.io.logs.spikes import leave_out_spikes

FLIGHT = fly_once(12.0)
NOTE = "{}: {} of 601 samples are spikes that no vehicle can follow, and are left out"
FIELDS = {"c": "thrust", "wx": "rates", "gx": "measured_rates", "fz": "acceleration"}
SENSORS = """
[measured_rates]
fields = ["gx", "gy", "gz"]
[acceleration]
fields = ["fx", "fy", "fz"]
axes = "world"
gravity = "removed"
"""


def read(tmp_path, table, text=MAP):
    path = write_csv(tmp_path / "log.csv", table)
    return read_flight_log(path, read_map(write_map(tmp_path / "map.toml", text)))


def all_columns():
    """Return the columns of a flight with a gyroscope and an accelerometer."""
    sensors = {f"g{a}": FLIGHT.omega[:, i].copy() for i, a in enumerate("xyz")}
    return columns(FLIGHT) | sensors | {f"f{a}": FLIGHT.a[:, i].copy() for i, a in enumerate("xyz")}


@pytest.mark.parametrize("field", FIELDS)
@pytest.mark.parametrize("value", [450.0, -450.0, 1e4, 1e12])
def test_spikes_are_left_out_and_counted(tmp_path, field, value):
    """The flight without them remains: a command is held, and a measurement is interpolated."""
    table = all_columns()
    intact = read(tmp_path, table, MAP + SENSORS)
    table[field][[200, 300, 400]] = value
    log = read(tmp_path, table, MAP + SENSORS)
    assert log.notes == (NOTE.format(FIELDS[field], 3),)
    assert log.agreement == pytest.approx(intact.agreement, abs=0.01)
    assert intact.seconds - 0.1 < log.seconds <= intact.seconds
    for name in ("c", "command", "rates", "a"):
        result, expected = getattr(log, name)[log.valid], getattr(intact, name)[log.valid]
        np.testing.assert_allclose(result, expected, atol=0.5)
        np.testing.assert_allclose(np.delete(result, [*range(190, 410)], axis=0),
                                   np.delete(expected, [*range(190, 410)], axis=0), atol=1e-9)  # fmt: skip


@pytest.mark.parametrize("ticks", [5, 50])
def test_fast_commands_remain(tmp_path, ticks):
    """A doublet beyond all other commands, and a step to a thrust beyond all others, last long enough to act."""
    table = columns(FLIGHT)
    table["wx"][300 : 300 + ticks] = 30.0
    table["wx"][300 + ticks : 300 + 2 * ticks] = -30.0
    table["c"][-ticks:] = 300.0
    path = write_csv(tmp_path / "log.csv", table)
    series = read_quantities(path, read_map(write_map(tmp_path / "map.toml")))[0]
    np.testing.assert_allclose(series["rates"].values[:, 0], table["wx"], rtol=1e-6)
    np.testing.assert_allclose(series["thrust"].values[:, 0], table["c"], rtol=1e-6)


def test_command_that_is_held_remains(tmp_path):
    """Some autopilots publish a command only when it changes."""
    t = np.concatenate([0.02 * np.arange(300), 6.4 + 0.02 * np.arange(280)])
    values = np.ones((len(t), 3))
    values[299] = 30.0
    series, notes = leave_out_spikes(Series(t, values), "rates", BodyRates(("x", "y", "z")))
    assert len(series.t) == len(t)
    assert not notes


def test_single_pulse_within_the_reach_of_a_vehicle_remains():
    values = 0.01 * np.ones((600, 3))
    values[300] = 15.0
    series, notes = leave_out_spikes(Series(0.02 * np.arange(600), values), "rates", BodyRates(("x", "y", "z")))
    assert series.values[300, 0] == 15.0
    assert not notes


def test_damaged_motor_command_in_dataflash_log_does_not_hide_agreement(tmp_path):
    flight = fly_body(4.0)
    motors = flight.motors.copy()
    motors[2000] = 254.8
    path = tmp_path / "flight.bin"
    path.write_bytes(dataflash(body_messages(dataclasses.replace(flight, motors=motors))))
    log = read_log(path)
    assert log.agreement["climb"] > 0.9
    assert not log.warnings
    assert log.valid[10:-10].all()
