"""The cost of a log follows its samples, however long the pauses between them are."""

import numpy as np
import pytest

from fake_log import MAP, columns, fly_once, write_map
from retrim.io.logs import read_flight_log, read_map
from retrim.io.logs.on_one_clock import LONGEST_PAUSE, PAUSE_END

FLIGHT = fly_once(12.0)
VELOCITY_ONLY = MAP.replace("[position]\nfields = ['px', 'py', 'pz']\n".replace("'", '"'), "")


def read(tmp_path, pauses, text=MAP, **changes):
    """Return the log of a flight with pauses [s] that begin after some rows."""
    table = columns(FLIGHT)
    for row, seconds in pauses.items():
        table["t"][row:] += seconds
    rows = zip(*table.values(), strict=True)
    path = tmp_path / "log.csv"
    path.write_text("\n".join([",".join(table), *(",".join(f"{x:.15g}" for x in row) for row in rows)]))
    return read_flight_log(path, read_map(write_map(tmp_path / "map.toml", text, **changes)))


@pytest.mark.parametrize("text", [MAP, VELOCITY_ONLY])
@pytest.mark.parametrize("seconds", [LONGEST_PAUSE + 0.02, 3600.0, 86400.0, 1e7])
def test_pause_has_no_ticks_and_the_flights_around_it_remain(tmp_path, seconds, text):
    log = read(tmp_path, {300: seconds}, text)
    assert len(log.t) < len(FLIGHT.t) + 2.0 * PAUSE_END / log.dt + 3
    np.testing.assert_allclose(np.diff(log.t), log.dt, atol=1e-6)
    assert log.seconds == pytest.approx(12.0, abs=0.3)
    assert f"{seconds + 0.08:.2f} s have gaps in the samples, and are left out" in log.notes or seconds < 20.0
    assert any(note.startswith("pauses are shortened to 10 s; the times after them are ") for note in log.notes)
    assert not any("jumps" in note for note in log.notes)
    result = np.concatenate([log.v[:250], log.v[-250:]])
    np.testing.assert_allclose(result, np.concatenate([FLIGHT.v[:250], FLIGHT.v[-250:]]), atol=0.05)
    assert np.ptp(log.p, axis=0).max() < 100.0


def test_ticks_follow_samples_of_many_pauses(tmp_path):
    log = read(tmp_path, dict.fromkeys(range(100, 600, 100), 1e5))
    assert len(log.t) < len(FLIGHT.t) + 5 * (2.0 * PAUSE_END / log.dt + 3)
    assert log.seconds == pytest.approx(12.0, abs=0.8)


def test_shorter_pause_keeps_its_length(tmp_path):
    log = read(tmp_path, {300: 11.0})
    assert log.t[-1] == pytest.approx(23.0, abs=0.03)
    assert not any("shortened" in note for note in log.notes)


def test_part_of_log_begins_in_pause(tmp_path):
    """The times of a part are those of the log, with its pauses."""
    log = read(tmp_path, {300: 86400.0}, part__start="40000.0")
    assert log.seconds == pytest.approx(6.0, abs=0.2)
    np.testing.assert_allclose(log.v[-250:], FLIGHT.v[-250:], atol=0.05)
