"""What a live flight leaves says of it what happened, and nothing of ticks that nobody accounted for."""

import jax
import numpy as np
import pytest
from jax import random

from helpers import tiny_preset
from live_processes import DT, level
from retrim.config.scenario import Scenario
from retrim.config.setup import Setup
from retrim.live.display import FIGURES, figures
from retrim.live.events import LiveEvents
from retrim.live.processes.plant import CRASHED
from retrim.live.report import flight_of, histograms, missing, results
from retrim.live.session import LiveRequest
from retrim.live.status import Status
from retrim.onboard.guard import HOVER, Mode
from retrim.onboard.messages import ACCOUNTS, COLUMNS, COMMAND, MEASURED, TRUE

pytestmark = pytest.mark.usefixtures("optax_promotion")


@pytest.fixture
def requests(tmp_path):
    with jax.numpy_dtype_promotion("standard"):
        setup = Setup.from_preset(tiny_preset())
        return LiveRequest(setup, setup.new_policy(random.key(0)), Scenario(), "full", 10.0, 0, 3.0, tmp_path)


def fly_once(calls, ticks=30):
    """Rows of a vehicle that hovers where it should, each step a millisecond long."""
    rows = np.zeros((ticks, len(COLUMNS)))
    rows[:, 0] = np.arange(ticks)
    rows[:, 1] = DT * rows[:, 0]
    rows[:, MEASURED] = rows[:, TRUE] = level(np.asarray(calls.setup.flight_task.home()))
    rows[:, COMMAND], rows[:, ACCOUNTS["step"]] = HOVER, 1e-3
    return rows


def report(calls, rows, end_note, stalls=None, **control):
    lines = [",".join(COLUMNS), *(",".join(map(repr, row)) for row in rows.tolist())]
    (calls.folder / "flight.csv").write_text("\n".join(lines) + "\n")
    status, events = Status(1.0, control, {}, {}, {}, end_note, [], False, 0, None, stalls or {}), LiveEvents()
    flight, result = flight_of(calls, (), status, None, calls.folder / "flight.csv")
    return {row["metric"]: row for row in results(calls, flight, result, status, events)}


def test_crash_is_counted_with_and_without_last_row(requests):
    rows = fly_once(requests)
    assert report(requests, rows, "landed")["steady"]["crashes"] == 0
    without = report(requests, rows, CRASHED)
    assert without["steady"]["crashes"] == 1
    assert without["steady"]["value"] is None
    assert without["recovery_5cm"]["value"] is None
    assert report(requests, rows, CRASHED, reason="landing")["steady"]["crashes"] == 0
    rows[-1, TRUE] = rows[-1, MEASURED] = level((0.0, 0.0, -1.0))
    assert report(requests, rows, CRASHED)["steady"]["crashes"] == 1


def test_table_of_flight_is_complete_and_has_labels_in_words(requests):
    rows = list(report(requests, fly_once(requests), "landed", missed=5).values())
    display = figures([*rows, {"metric": "later_figure", "value": 1.0}])
    assert len(display) < len(rows)
    assert not any("_" in label for label, _, _ in display)
    assert ("missed ticks, in stalls of the machine", "", "5, -") in display
    assert ("later figure", "", "1") in display
    assert {name for _, _, names, _ in FIGURES for name in names} == {row["metric"] for row in rows}
    assert ("error, last seconds", "mm", "0") in display


def test_ticks_missed_in_stalls_are_counted_separately(requests):
    gaps = [(10.0, 10.04, 1), (11.0, 11.08, 3), (12.0, 12.04, 1)]
    stalls = {"count": 2, "longest": 0.05, "newest": [[11.01, 11.06], [12.05, 12.06]]}
    result = report(requests, fly_once(requests), "landed", stalls, missed=5, gaps=gaps)
    assert [result[name]["value"] for name in ("missed_ticks", "missed_in_stalls", "stalls")] == [5, 3, 2]
    assert result["stall_max_ms"]["value"] == pytest.approx(50.0)
    unknown = report(requests, fly_once(requests), "landed", missed=5, gaps=gaps)  # the watchdog came behind others
    assert [unknown[name]["value"] for name in ("missed_in_stalls", "stalls", "stall_max_ms")] == [None] * 3


def test_statistics_contain_hangs_and_exclude_untimed_ticks(requests):
    rows = fly_once(requests)
    rows[20, ACCOUNTS["step"]] = 0.06
    rows[20:23, -1] = Mode.WATCHDOG
    rows[21:24, ACCOUNTS["step"]] = 0.0  # the watchdog's own, which it flew or has seen
    result = report(requests, rows, "landed")
    assert result["step_max_ms"]["value"] == pytest.approx(60.0)
    assert result["step_p50_ms"]["value"] == pytest.approx(1.0)
    assert result["fallback_ticks"]["value"] == 3
    assert [ticks for ticks in histograms(rows)["step"] if ticks] == [26, 1]


def test_log_shorter_than_flight_is_fault_except_for_missed_ticks(requests):
    rows = fly_once(requests, ticks=340)

    def lose(rows, ticks=340, **control):
        return missing(rows, Status(1.0, control, {}, {}, {}, "landed", [], False, 0, None, ticks=ticks), DT)

    assert lose(rows) == lose(rows[:-5]) == lose(rows[20:]) == lose(rows, ticks=0) == []
    text = "the log is shorter than the flight: it holds"
    assert lose(rows[:100]) == [f"{text} 100 of 340 ticks, none from 2.00 to 6.80 s"]
    assert lose(rows[50:]) == [f"{text} 290 of 340 ticks, none from 0.00 to 1.00 s"]
    holed = np.delete(rows, np.arange(100, 200), axis=0)
    assert lose(holed) == [f"{text} 240 of 340 ticks, none from 2.00 to 4.00 s"]
    assert lose(holed, gaps=[(2.0, 4.0, 100)]) == []
    assert lose(rows[:0]) == [f"{text} 0 of 340 ticks, none from 0.00 to 6.80 s"]


def test_dropped_vehicle_is_crash_and_commands_are_counted(requests):
    rows = fly_once(requests)
    rows[20:, -1], rows[20:, ACCOUNTS["step"]] = Mode.BLIND, 0.0
    rows[-1, -1] = Mode.DROP
    result = report(requests, rows, "stopped without measurements at 0.87 m", reason="the newest measurement is old")
    assert result["steady"]["crashes"] == 1
    assert result["steady"]["value"] is None
    assert result["fallback_ticks"]["value"] == 10
    landing = report(requests, rows, "stopped without measurements at 0.87 m", reason="landing")
    assert landing["steady"]["crashes"] == 0
