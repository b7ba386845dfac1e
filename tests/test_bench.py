"""The benchmark: times relative to the machine's own unit, on one core and on all."""

import json
import subprocess
import sys

import pytest

from retrim.bench import measure, timing
from retrim.bench.machine import UNIT_FLOP
from retrim.errors import ConfigError
from retrim.runkit.reporter import Silent
from retrim.runkit.run import Run


def test_units_follow_speed_of_machine(monkeypatch):
    """If the machine becomes ten times slower during a run, the result in units is the same."""
    units, took = iter([0.1, 0.1, 1.0, 1.0, 1.0]), iter([0.3, 1.65, 3.0, 3.0])
    monkeypatch.setattr(timing, "unit", lambda: lambda: next(units))
    monkeypatch.setattr(timing, "seconds", lambda run: next(took))
    result = timing.time_runs(2.0, lambda: None, 4)
    assert result["units"] == pytest.approx(3.0)
    assert result["run_s"] == pytest.approx((1.65 + 3.0) / 2)
    assert (result["compile_s"], result["remarks"]) == (2.0, "0.3 to 3 s in 4 runs")


@pytest.mark.skipif("one" not in measure.CORES, reason="the system does not let a process choose its core")
def test_one_core_run_uses_one_core():
    code = "import os; from retrim.bench.machine import on_core; on_core(0); print(len(os.sched_getaffinity(0)))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout == "1\n"


def test_row_has_both_times_and_share_of_limit(tmp_path, monkeypatch):
    """An update of four units for the products of one unit is at 25 % of the limit; one core runs first."""
    calls = []

    def process(name, cores, environment):
        calls.append((name, cores))
        if name == "machine":
            return {"product": 100.0, "rows": 50.0, "copy": 9.0}
        units = 4.0 if cores == "one" else 2.5
        row = {"work": name, "goal": "-", "paper": "-", "peak_mb": 7.0, "compile_s": 1.0, "remarks": "3 runs"}
        return row | {"run_s": units / 10, "units": units, "flop": UNIT_FLOP}

    monkeypatch.setattr(measure, "_process", process)
    monkeypatch.setattr(measure, "CORES", ("one", "all"))
    assert measure.bench(Run("test", tmp_path), Silent(), works=["update-retrim", "update-lora"])
    assert calls == [
        *(("machine", "one"), ("machine", "all")),
        *(("update-retrim", "all"), ("update-retrim", "one"), ("update-lora", "all")),
    ]
    text = (tmp_path / "bench.md").read_text()
    assert "| one core | 100.0 | 50.0 | 9.0 |" in text
    assert "| update-retrim | 0.4 | 4 | 0.25 | 2.5 | 25 % | 1 | - | - | 7 | 3 runs |" in text
    assert "| update-lora | - | - | 0.25 | 2.5 | 40 % | 1 | - | - | 7 | 3 runs |" in text
    rows = json.loads((tmp_path / "bench.json").read_text())["rows"]
    assert [row["name"] for row in rows] == ["machine", "machine", "update-retrim", "update-lora"]
    with pytest.raises(ConfigError, match="no work nap"):
        measure.bench(Run("test", tmp_path), Silent(), works=["nap"])
