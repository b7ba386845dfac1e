"""A killed sweep continues to the same rows as an uninterrupted one."""

import json
import signal
import tomllib
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest

from commands import OVERLAY, results, retrim, start_process
from fake_flights import flight
from helpers import brief_preset
from retrim import ConfigError, Fleet, Scenario, Setup
from retrim.config import read_vehicle
from retrim.evaluation import policies, sweep
from retrim.evaluation.executor import Flights
from retrim.evaluation.flight_table import millimetres
from retrim.evaluation.metrics import record
from retrim.evaluation.sweep import Sweep, read_sweep, run_sweep
from retrim.runkit import FlightSpec, Run, provenance
from retrim.runkit.reporter import Silent

pytestmark = pytest.mark.usefixtures("as_a_user")

SWEEP = (
    """
seeds = [0, 1]
methods = ["base", "indi"]
disturbances = ["none", "wind=3"]
plants = ["simple"]
seconds = 1.2
"""
    + OVERLAY
)
COMBINATIONS = [(name, method) for name in ("none", "wind=3") for method in ("base", "indi")]
# A power cut right after the first flight was stored.
KILLED = """
import os, signal
from retrim.evaluation.sweep import _FlightRows
add = _FlightRows.add
_FlightRows.add = lambda self, rows: add(self, rows) or os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory, as_a_user):
    """Return a folder with a finished sweep of two seeds, two disturbances and two methods."""
    here = tmp_path_factory.mktemp("user")
    (here / "sweep.toml").write_text(SWEEP)
    retrim("sweep", "sweep.toml", "--out", "whole", cwd=here)
    return here


def fly_once(folder):
    path = folder / "flights.jsonl"
    return path.read_text().splitlines() if path.exists() else []


def test_sweep_writes_table_json_plot_policies_and_rows(folder):
    result = results(folder / "whole", "sweep.json")
    assert [(row["disturbance"], row["method"], row["n"]) for row in result["rows"]] == [
        (*each, 2) for each in COMBINATIONS
    ]
    assert result["seeds"] == [0, 1]
    assert result["sweep"]["seconds"] == 1.2
    text = (folder / "whole" / "sweep.md").read_text()
    assert "| disturbance | method | error at the end [mm] | median [mm] | maximum [mm] | worst after 0.6" in text
    assert all(f"| {name} | {method} | {millimetres(row['mean'])} ±" in text
               for (name, method), row in zip(COMBINATIONS, result["rows"], strict=True))  # fmt: skip
    assert "![sweep](sweep.png)" in text
    assert (folder / "whole" / "sweep.png").stat().st_size > 10_000
    assert len(list((folder / "whole" / "policies").iterdir())) == 2
    assert len(fly_once(folder / "whole")) == 8


def test_killed_sweep_continues_to_same_rows(folder):
    process = start_process(("sweep", "sweep.toml", "--out", "cut"), folder, KILLED)
    out, _ = process.communicate(timeout=180)
    rows_so_far = fly_once(folder / "cut")
    assert (process.returncode, 0 < len(rows_so_far) < 8) == (-signal.SIGKILL, True), out.decode()
    assert not (folder / "cut" / "sweep.json").exists()
    policies = {path: path.stat().st_mtime_ns for path in (folder / "cut" / "policies").iterdir()}
    with (folder / "cut" / "flights.jsonl").open("a") as file:
        file.write('{"key": "torn')  # as a file system may leave it

    out = retrim("sweep", "sweep.toml", "--out", "cut", cwd=folder)
    assert "pretraining" not in out
    assert out.count("flights.jsonl: unusable lines, 1;") == 1
    assert {path: path.stat().st_mtime_ns for path in (folder / "cut" / "policies").iterdir()} == policies
    assert results(folder / "cut", "sweep.json")["rows"] == results(folder / "whole", "sweep.json")["rows"]
    again = fly_once(folder / "cut")
    assert again[: len(rows_so_far)] == rows_so_far  # not repeated
    assert sorted(again) == sorted(fly_once(folder / "whole"))


def test_finished_sweep_flies_nothing_and_smaller_one_reports_its_flights(folder):
    before = results(folder / "whole", "sweep.json")["rows"]
    out = retrim("sweep", "sweep.toml", "--out", "whole", cwd=folder)
    assert "flying" not in out
    assert results(folder / "whole", "sweep.json")["rows"] == before
    smaller = SWEEP.replace("[0, 1]", "[1]").replace('["none", "wind=3"]', '["wind=3"]')
    (folder / "smaller.toml").write_text(smaller)
    out = retrim("sweep", "smaller.toml", "--out", "whole", cwd=folder)
    assert "flying" not in out
    result = results(folder / "whole", "sweep.json")["rows"]
    assert [(row["disturbance"], row["method"], row["n"]) for row in result] == [
        ("wind=3", "base", 1), ("wind=3", "indi", 1)
    ]  # fmt: skip
    rows = [json.loads(line) for line in fly_once(folder / "whole")]
    (mine,) = [r["error"] for r in rows if (r["seed"], r["disturbance"], r["method"]) == (1, "wind=3", "base")]
    assert result[0]["mean"] == pytest.approx(mine)


def test_log_of_each_flight_is_written_once(folder):
    sweep_text = SWEEP.replace("[0, 1]", "[1]").replace('["none", "wind=3"]', '["none"]').replace('"base", ', "")
    (folder / "logs.toml").write_text("logs = true\n" + sweep_text)
    out = retrim("sweep", "logs.toml", "--out", "whole", cwd=folder)
    assert "flying" in out  # the rows exist, but not the logs
    assert len(fly_once(folder / "whole")) == 8  # other rows stay
    (row,) = (json.loads(line) for line in fly_once(folder / "whole") if '"log"' in line)
    with np.load(folder / "whole" / row["log"]) as log:
        assert log["t"][-1] == pytest.approx(1.2)
        assert log["error"].min() <= row["error"] <= log["error"].max()
    assert "flying" not in retrim("sweep", "logs.toml", "--out", "whole", cwd=folder)


def test_changed_code_or_files_repeat_training_and_flights(tmp_path, monkeypatch):
    """Policies and flights of different code, or of a file that has changed since, are not reused."""
    monkeypatch.chdir(tmp_path)
    overlay = tomllib.loads(OVERLAY)["overlay"]
    calls = Sweep(methods=("indi",), disturbances=("none",), plants=("simple",), seconds=1.0, overlay=overlay)
    trainings = []
    monkeypatch.setattr(sweep, "bars", lambda *_: None)
    monkeypatch.setattr(sweep, "save", lambda figure, folder, stem: (folder / f"{stem}.png", folder / f"{stem}.svg"))
    setup = policies.train
    monkeypatch.setattr(policies, "train", lambda *a, **k: trainings.append(0) or setup(*a, **k))

    def fly():
        trainings.clear()
        run_sweep(calls, Run("sweep", tmp_path / "out"), Silent())
        return len(trainings), len(fly_once(tmp_path / "out"))

    assert [fly(), fly()] == [(1, 1), (0, 1)]
    assert "An earlier run had made 1 of the parts" in (tmp_path / "out" / "sweep.md").read_text()
    monkeypatch.setattr(provenance, "code", lambda: "changed")
    assert fly() == (1, 2)
    assert results(tmp_path / "out", "sweep.json")["rows"][0]["n"] == 1
    for module in (sweep, policies):
        monkeypatch.setattr(module, "file_digests", lambda *names: {"mine.csv": "changed"})
    assert fly() == (1, 3)


def test_vehicle_file_is_relative_to_sweep_file(tmp_path):
    studies = tmp_path / "studies"
    studies.mkdir()
    text = (Path(__file__).parents[2] / "examples" / "extensions" / "vehicle.toml").read_text()
    (studies / "my.toml").write_text(text)
    (studies / "s.toml").write_text('vehicles = ["my.toml", "large"]\n[overlay]\nvehicle = "my.toml"\n')
    result = read_sweep(studies / "s.toml")
    assert [s.vehicle if isinstance(s.vehicle, str) else s.vehicle.mass for s in result.scenarios()] == [1.2, "large"]
    assert result.overlay["vehicle"]["mass"] == 1.2
    (studies / "s.toml").write_text('vehicles = ["none_such.toml"]\n')
    with pytest.raises(ConfigError, match=r"none_such\.toml"):
        read_sweep(studies / "s.toml")


VEHICLE = read_vehicle(Path(__file__).parents[2] / "examples" / "extensions" / "vehicle.toml")
TWICE = {"presets": "hover/fast", "methods": "base", "disturbances": "none", "plants": "bem", "sensors": "ideal",
         "references": "circle"}  # fmt: skip


@pytest.mark.parametrize(
    ("keys", "text"),
    [
        *(({name: (value, value)}, f"{name}: '{value}' is listed twice; list each") for name, value in TWICE.items()),
        ({"seeds": (2, 2)}, "seeds 2, 2: at least one is needed, and each only once"),
        ({"vehicles": ("small", "small")}, "two vehicles are named 'small'; list each only once"),
        ({"vehicles": (VEHICLE, replace(VEHICLE, mass=0.6))}, "two vehicles are named 'seven-inch'"),
        ({"vehicles": (replace(VEHICLE, name="small"), "small")}, "give each file its own name"),
        ({"presets": ("hover/fast", "hover/retrim"), "overlay": {"name": "x"}}, "two presets are named 'x'; give each"),
    ],
    ids=lambda value: ", ".join(value) if isinstance(value, dict) else "",
)
def test_rows_of_one_name_are_refused_before_training(keys, text, tmp_path):
    """Flights of different things would be in one row, or a flight would count twice."""
    with pytest.raises(ConfigError, match=text) as error:
        run_sweep(Sweep(**keys), Run("sweep", tmp_path / "out"), Silent())
    assert "\n" not in str(error.value)
    assert not (tmp_path / "out").exists()


def test_sweep_contains_every_combination():
    sweep = Sweep(disturbances=("none", "wind"), plants=("bem", "simple"), sensors=("ideal", "mocap"))
    result = sweep.scenarios()
    assert len(set(result)) == 8
    assert Scenario("wind", "simple", None, "mocap") in result


def test_report_has_row_per_combination_and_bar_per_flight(tmp_path, monkeypatch):
    """Crashes are infinite in the bars and counted in the cells; a flight that failed remotely has no bar."""
    display = []

    def draw(title, groups):
        display.append(groups)

    monkeypatch.setattr(sweep, "bars", draw)
    monkeypatch.setattr(sweep, "save", lambda figure, folder, stem: (folder / f"{stem}.png", folder / f"{stem}.svg"))
    calls = Sweep(seeds=(0, 1), methods=("base", "indi"), disturbances=("none", "large"), starts=2)
    rest = []
    for scenario in calls.scenarios():
        for method in calls.methods:
            for k, error in enumerate((0.1, 0.2, 0.4, 0.1 if scenario.disturbance == "none" else None)):
                spec = FlightSpec(scenario, method, k % 2, k // 2)
                crashes = method == "base" and error is None
                row = record(flight(0.1 if error is None else error, spec=spec, terminated=crashes))
                row |= {"error": error}  # a mean is equal to one up to rounding
                if method == "indi" and error is None:
                    row |= {"failed": "OSError: gone"}
                rest.append({"preset": "p", **row})
    result = sweep._report(calls, rest, Run("test", tmp_path), Silent())
    assert [(row["disturbance"], row["method"], row["n"], row["crashes"]) for row in result] == [
        ("none", "base", 4, 0), ("none", "indi", 4, 0), ("large", "base", 4, 1), ("large", "indi", 4, 0)
    ]  # fmt: skip
    text = (tmp_path / "sweep.md").read_text()
    assert "| disturbance | method | error at the end [mm] | median [mm] | maximum [mm] | worst after" in text
    assert "| none | base | 200 ± 141 | 150 | 400 |" in text
    assert "| large | base | 233 ± 153, 1 of 4 crashed | 300 | crashed |" in text
    assert "| large | indi | 233 ± 153, 1 of 4 failed | 200 | 400 |" in text
    assert results(tmp_path, "sweep.json")["rows"] == result
    (bars,) = display
    assert bars == {
        "none": {"base": [0.1, 0.2, 0.4, 0.1], "indi": [0.1, 0.2, 0.4, 0.1]},
        "large": {"base": [0.1, 0.2, 0.4, float("inf")], "indi": [0.1, 0.2, 0.4]},
    }
    one = [row for row in rest if row["disturbance"] == "large"]
    run = Run("test", tmp_path)
    run.reused = 3
    sweep._report(calls, one, run, Silent())
    assert "An earlier run had made 3 of the parts" in (tmp_path / "sweep.md").read_text()
    assert list(display[1]) == ["large"]  # if nothing varies, the disturbance is the label


def test_failed_remote_flights_are_recorded_and_repeated(tmp_path, monkeypatch):
    """The other flights of a sweep finish, and the exit code reports the failure."""
    preset, text = brief_preset(), []
    policies = {0: Setup.from_preset(preset).new_policy(jax.random.key(0))}
    fleet = Fleet(preset, policies, [Scenario(plant="simple")], methods=("base",), starts=2, seconds=1.2)
    reporter, run = Silent(), Run("test", tmp_path)
    flight_rows = sweep._FlightRows(run, reporter, {})
    reporter.say = text.append
    calls = []

    def flies(executor, *, stop, only, on_result, progress, by_batch, forget):
        calls.append((executor, list(only), by_batch, forget))
        on_result([flight(0.1, spec=spec) for spec in only[:1]])
        return Flights([], interrupted=False, failed=dict.fromkeys(only[1:], "OSError: gone"))

    monkeypatch.setattr(fleet, "run", flies)
    sweep._fly(
        fleet, {spec: sweep._key(fleet.preset, spec, fleet.seconds) for spec in fleet.specs}, flight_rows, run, reporter
    )
    assert (run.failed, run.exit_code) == (True, 1)
    assert text == ["1 flights failed in other processes, the first with OSError: gone; the same command flies them"]
    rows = [json.loads(line) for line in fly_once(tmp_path)]
    assert [(row["start"], row["failed"], row["preset"], row["vehicle"]) for row in rows] == [
        (0, None, preset.name, "small"), (1, "OSError: gone", preset.name, "small")
    ]  # fmt: skip
    sweep._fly(
        fleet,
        {spec: sweep._key(fleet.preset, spec, fleet.seconds) for spec in fleet.specs},
        sweep._FlightRows(run, reporter, {}),
        run,
        reporter,
    )
    assert calls == [(None, fleet.specs, True, True), (None, fleet.specs[1:], True, True)]
