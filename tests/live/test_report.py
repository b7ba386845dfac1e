"""The report of a live flight contains crashes, faults and times, and excludes ticks without measured times."""

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
def live_request(tmp_path):
    with jax.numpy_dtype_promotion("standard"):
        setup = Setup.from_preset(tiny_preset())
        return LiveRequest(setup, setup.new_policy(random.key(0)), Scenario(), "full", 10.0, 0, 3.0, tmp_path)


def hover_rows(live_request, ticks=30):
    """Return rows of a vehicle that hovers at its target, with steps of 1 ms."""
    rows = np.zeros((ticks, len(COLUMNS)))
    rows[:, 0] = np.arange(ticks)
    rows[:, 1] = DT * rows[:, 0]
    rows[:, MEASURED] = rows[:, TRUE] = level(np.asarray(live_request.setup.flight_task.home()))
    rows[:, COMMAND], rows[:, ACCOUNTS["step"]] = HOVER, 1e-3
    return rows


def report(live_request, rows, end_note, stalls=None, **control):
    lines = [",".join(COLUMNS), *(",".join(map(repr, row)) for row in rows.tolist())]
    (live_request.folder / "flight.csv").write_text("\n".join(lines) + "\n")
    status, events = Status(1.0, control, {}, {}, {}, end_note, [], False, 0, None, stalls or {}), LiveEvents()
    flight, result = flight_of(live_request, (), status, None, live_request.folder / "flight.csv")
    return {row["metric"]: row for row in results(live_request, flight, result, status, events)}


def test_crash_is_counted_with_and_without_last_row(live_request):
    rows = hover_rows(live_request)
    assert report(live_request, rows, "landed")["steady"]["crashes"] == 0
    without = report(live_request, rows, CRASHED)
    assert without["steady"]["crashes"] == 1
    assert without["steady"]["value"] is None
    assert without["recovery_5cm"]["value"] is None
    assert report(live_request, rows, CRASHED, reason="landing")["steady"]["crashes"] == 0
    rows[-1, TRUE] = rows[-1, MEASURED] = level((0.0, 0.0, -1.0))
    assert report(live_request, rows, CRASHED)["steady"]["crashes"] == 1


def test_table_of_flight_is_complete_and_has_labels_in_words(live_request):
    rows = list(report(live_request, hover_rows(live_request), "landed", missed=5).values())
    display = figures([*rows, {"metric": "later_figure", "value": 1.0}])
    assert len(display) < len(rows)
    assert not any("_" in label for label, _, _ in display)
    assert ("missed ticks, in stalls of the machine", "", "5, -") in display
    assert ("later figure", "", "1") in display
    assert {name for _, _, names, _ in FIGURES for name in names} == {row["metric"] for row in rows}
    assert ("error, last seconds", "mm", "0") in display


def test_ticks_missed_in_stalls_are_counted_separately(live_request):
    gaps = [(10.0, 10.04, 1), (11.0, 11.08, 3), (12.0, 12.04, 1)]
    stalls = {"count": 2, "longest": 0.05, "newest": [[11.01, 11.06], [12.05, 12.06]]}
    result = report(live_request, hover_rows(live_request), "landed", stalls, missed=5, gaps=gaps)
    assert [result[name]["value"] for name in ("missed_ticks", "missed_in_stalls", "stalls")] == [5, 3, 2]
    assert result["stall_max_ms"]["value"] == pytest.approx(50.0)
    unknown = report(live_request, hover_rows(live_request), "landed", missed=5, gaps=gaps)  # without measured stalls
    assert [unknown[name]["value"] for name in ("missed_in_stalls", "stalls", "stall_max_ms")] == [None] * 3


def test_statistics_contain_hangs_and_exclude_untimed_ticks(live_request):
    rows = hover_rows(live_request)
    rows[20, ACCOUNTS["step"]] = 0.06
    rows[20:23, -1] = Mode.WATCHDOG
    rows[21:24, ACCOUNTS["step"]] = 0.0  # control measured no times in these ticks
    result = report(live_request, rows, "landed")
    assert result["step_max_ms"]["value"] == pytest.approx(60.0)
    assert result["step_p50_ms"]["value"] == pytest.approx(1.0)
    assert result["fallback_ticks"]["value"] == 3
    assert [ticks for ticks in histograms(rows)["step"] if ticks] == [26, 1]


def test_log_shorter_than_flight_is_fault_except_for_missed_ticks(live_request):
    rows = hover_rows(live_request, ticks=340)

    def find_gaps(rows, ticks=340, **control):
        return missing(rows, Status(1.0, control, {}, {}, {}, "landed", [], False, 0, None, ticks=ticks), DT)

    assert find_gaps(rows) == find_gaps(rows[:-5]) == find_gaps(rows[20:]) == find_gaps(rows, ticks=0) == []
    text = "the log is shorter than the flight: it holds"
    assert find_gaps(rows[:100]) == [f"{text} 100 of 340 ticks, none from 2.00 to 6.80 s"]
    assert find_gaps(rows[50:]) == [f"{text} 290 of 340 ticks, none from 0.00 to 1.00 s"]
    holed = np.delete(rows, np.arange(100, 200), axis=0)
    assert find_gaps(holed) == [f"{text} 240 of 340 ticks, none from 2.00 to 4.00 s"]
    assert find_gaps(holed, gaps=[(2.0, 4.0, 100)]) == []
    assert find_gaps(rows[:0]) == [f"{text} 0 of 340 ticks, none from 0.00 to 6.80 s"]


def test_dropped_vehicle_is_crash_and_commands_are_counted(live_request):
    rows = hover_rows(live_request)
    rows[20:, -1], rows[20:, ACCOUNTS["step"]] = Mode.BLIND, 0.0
    rows[-1, -1] = Mode.DROP
    result = report(
        live_request, rows, "stopped without measurements at 0.87 m", reason="the newest measurement is old"
    )
    assert result["steady"]["crashes"] == 1
    assert result["steady"]["value"] is None
    assert result["fallback_ticks"]["value"] == 10
    landing = report(live_request, rows, "stopped without measurements at 0.87 m", reason="landing")
    assert landing["steady"]["crashes"] == 0
