"""Sweeps: a killed one goes on to the rows of one that ran through."""

import json
import signal
import time

import pytest

from commands import OVERLAY, results, retrim, started
from retrim import Scenario
from retrim.experiments.sweep import Sweep

pytestmark = pytest.mark.usefixtures("as_a_user")

SWEEP = (
    """
seeds = [0, 1]
disturbances = ["none", "wind=3"]
plants = ["simple"]
seconds = 1.2
"""
    + OVERLAY
)
COMBINATIONS = [(name, method) for name in ("none", "wind=3") for method in ("base", "full")]


@pytest.fixture(scope="module")
def folder(tmp_path_factory, as_a_user):
    """A folder with a sweep of two seeds, two disturbances and two methods that ran through."""
    here = tmp_path_factory.mktemp("user")
    (here / "sweep.toml").write_text(SWEEP)
    retrim("sweep", "sweep.toml", "--out", "whole", cwd=here)
    return here


def flown(folder):
    path = folder / "flights.jsonl"
    return path.read_text().splitlines() if path.exists() else []


def test_a_sweep_leaves_a_table_json_a_picture_policies_and_rows(folder):
    found = results(folder / "whole", "sweep.json")
    assert [(row["disturbance"], row["method"], row["n"]) for row in found["rows"]] == [
        (*each, 2) for each in COMBINATIONS
    ]
    assert found["seeds"] == [0, 1]
    assert found["sweep"]["seconds"] == 1.2
    text = (folder / "whole" / "sweep.md").read_text()
    assert "| disturbance | method | mean ± std [m] | median [m] | maximum [m] |" in text
    assert all(f"| {name} | {method} | {row['mean']:.3f} ±" in text
               for (name, method), row in zip(COMBINATIONS, found["rows"], strict=True))  # fmt: skip
    assert "![sweep](sweep.png)" in text
    assert (folder / "whole" / "sweep.png").stat().st_size > 10_000
    assert len(list((folder / "whole" / "policies").iterdir())) == 2
    assert len(flown(folder / "whole")) == 8


def test_a_killed_sweep_goes_on_to_the_same_rows(folder):
    process = started(
        ("sweep", "sweep.toml", "--out", "cut"), folder, setup="import retrim.experiments.sweep as s\ns.BATCH = 2"
    )
    deadline = time.monotonic() + 180
    while not flown(folder / "cut") and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.002)
    process.send_signal(signal.SIGKILL)
    out, _ = process.communicate(timeout=60)
    kept = flown(folder / "cut")
    assert 0 < len(kept) < 8, out.decode()
    assert not (folder / "cut" / "sweep.json").exists()
    policies = {path: path.stat().st_mtime_ns for path in (folder / "cut" / "policies").iterdir()}
    with (folder / "cut" / "flights.jsonl").open("a") as file:
        file.write('{"key": "torn')  # as a file system may leave it

    out = retrim("sweep", "sweep.toml", "--out", "cut", cwd=folder)
    assert "pretraining" not in out
    assert {path: path.stat().st_mtime_ns for path in (folder / "cut" / "policies").iterdir()} == policies
    assert results(folder / "cut", "sweep.json")["rows"] == results(folder / "whole", "sweep.json")["rows"]
    again = flown(folder / "cut")
    assert again[: len(kept)] == kept  # not flown twice
    assert sorted(again) == sorted(flown(folder / "whole"))


def test_a_sweep_that_is_done_flies_nothing_and_a_smaller_one_reports_its_own_flights(folder):
    before = results(folder / "whole", "sweep.json")["rows"]
    out = retrim("sweep", "sweep.toml", "--out", "whole", cwd=folder)
    assert "flying" not in out
    assert results(folder / "whole", "sweep.json")["rows"] == before
    smaller = SWEEP.replace("[0, 1]", "[1]").replace('["none", "wind=3"]', '["wind=3"]')
    (folder / "smaller.toml").write_text(smaller)
    out = retrim("sweep", "smaller.toml", "--out", "whole", cwd=folder)
    assert "flying" not in out
    found = results(folder / "whole", "sweep.json")["rows"]
    assert [(row["disturbance"], row["method"], row["n"]) for row in found] == [
        ("wind=3", "base", 1), ("wind=3", "full", 1)
    ]  # fmt: skip
    rows = [json.loads(line) for line in flown(folder / "whole")]
    (mine,) = [r["error"] for r in rows if (r["seed"], r["disturbance"], r["method"]) == (1, "wind=3", "base")]
    assert found[0]["mean"] == pytest.approx(mine)


def test_a_sweep_is_every_combination():
    sweep = Sweep(disturbances=("none", "wind"), plants=("bem", "simple"), sensors=("ideal", "mocap"))
    found = sweep.scenarios()
    assert len(set(found)) == 8
    assert Scenario("wind", "simple", None, "mocap") in found
