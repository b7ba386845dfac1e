"""Commands as a user runs them, at reduced size: results, pictures, wrong input, Ctrl-C."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from retrim.adapt import Log
from retrim.config import presets
from retrim.config.registry import Scenario
from retrim.experiments.figures import picture, spans
from retrim.experiments.fleet import Flight, Plan
from retrim.experiments.metrics import cell, rows

SMALL = "[pretrain]\nhidden = [64, 64]\nepochs = 150\n[adapt]\nepochs = 4\nenvs = 4\niters = 20\nrefine_every = 1.0\nimprove_every = 1.5\nrefine_charge = 0.1\nimprove_charge = 0.3\n"  # noqa: E501
ENVIRONMENT = {**os.environ, "COLUMNS": "160", "NO_COLOR": "1"}


def retrim(*words, cwd, code=0):
    ran = subprocess.run(
        [sys.executable, "-m", "retrim.cli", *words], cwd=cwd, env=ENVIRONMENT, capture_output=True, text=True
    )
    assert ran.returncode == code, ran.stdout + ran.stderr
    assert "Traceback" not in ran.stderr
    return ran.stdout + ran.stderr


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with a small policy in p/."""
    here = tmp_path_factory.mktemp("user")
    (here / "small.toml").write_text(SMALL)
    out = retrim("pretrain", "hover", "--config", "small.toml", "--out", "p", cwd=here)
    assert "hover error in its own model" in out
    return here


def test_pretrain_writes_policy_and_results(folder):
    results = json.loads((folder / "p" / "results.json").read_text())
    assert {
        "schema",
        "command",
        "commit",
        "versions",
        "device",
        "seeds",
        "compile_s",
        "run_s",
        "rows",
    } <= results.keys()
    assert len(results["losses"]) == 150
    assert results["rows"][0]["epochs"] == 150
    assert (folder / "p" / "policy.safetensors").stat().st_size > 1000


def test_fly_writes_rows_events_and_pictures(folder):
    out = retrim(
        "fly", "--policy", "p", "--disturbance", "small", "--seconds", "5", "--starts", "2", "--out", "f", cwd=folder
    )
    results = json.loads((folder / "f" / "results.json").read_text())
    assert [row["method"] for row in results["rows"]] == ["base", "full"]
    for row in results["rows"]:
        keys = {"task", "plant", "vehicle", "sensing", "disturbance", "method", "metric", "mean", "std", "n", "crashes"}
        assert row.keys() == keys
        assert row["n"] == 2
        assert row["crashes"] == 0
        assert np.isfinite(row["mean"])
    events = [json.loads(line) for line in (folder / "f" / "events.jsonl").read_text().splitlines()]
    assert {e["event"] for e in events} >= {"residual"}
    for kind in ("png", "svg"):
        assert (folder / "f" / f"hover_small.{kind}").stat().st_size > 10_000
    assert "hover error [m], last 2 s of 5 s, 2" in out


def test_fly_repeats(folder):
    words = "fly", "--policy", "p", "--seconds", "4", "--disturbance", "small"
    retrim(*words, "--out", "a", cwd=folder)
    retrim(*words, "--out", "b", cwd=folder)
    first, second = (json.loads((folder / name / "results.json").read_text())["rows"] for name in "ab")
    assert first == second
    assert (folder / "a" / "events.jsonl").read_text() == (folder / "b" / "events.jsonl").read_text()


def test_fly_without_adaptation_and_measured(folder):
    retrim("fly", "--policy", "p", "--seconds", "3", "--adapt", "none", "--out", "n", cwd=folder)
    assert [r["method"] for r in json.loads((folder / "n" / "results.json").read_text())["rows"]] == ["base"]
    retrim("fly", "--policy", "p", "--seconds", "3", "--charge", "measured", "--out", "m", cwd=folder)


def test_default_folder(folder):
    retrim("fly", "--policy", "p", "--seconds", "3", "--adapt", "none", cwd=folder)
    assert list((folder / "runs").glob("fly-*/results.json"))


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        (("fly", "--policy", "nothing"), 1, "nothing: no such file; `retrim pretrain hover --out DIR` makes one"),
        (("fly", "--policy", "p", "--disturbance", "huge"), 1, "no disturbance 'huge'; there are none, small"),
        (("fly", "--policy", "p", "--seconds", "1"), 1, "at least 3 s and 1 start are needed"),
        (("fly", "--policy", "p", "--config", "small.toml", "--vehicle", "x"), 2, "invalid choice 'x'"),
        (("pretrain", "hover", "--preset", "nope"), 1, "no preset 'nope'; there are paper, released, fast"),
        (("pretrain", "dance"), 2, "invalid choice 'dance'"),
        (("pretrain", "hover", "--epochs", "0"), 1, "pretrain.epochs: Input should be greater than 0"),
        (("bench", "--works", "nap"), 2, "no work nap; there are pretrain-paper"),
        ((), 2, "Expected one of {pretrain, fly"),
    ],
)
def test_wrong_input_gives_one_clear_message(folder, words, code, message):
    assert message in retrim(*words, cwd=folder, code=code)


def test_an_overlay_cannot_change_what_the_weights_were_trained_for(folder):
    (folder / "other.toml").write_text("history = 3\n")
    out = retrim("fly", "--policy", "p", "--config", "other.toml", cwd=folder, code=1)
    assert "history = 3, but the policy was trained with 2" in out


def flight(start, *, crashed, error, method="base"):
    ticks = 10 if crashed else 200
    log = Log(0.02 * np.arange(ticks), *(np.zeros((ticks, n)) for n in (3, 9, 3, 4)), crashed)
    return Flight(Plan("large", method, start), log, np.full(ticks, error), ())


def test_crashes_are_counted_and_left_out_of_the_mean():
    found = [
        flight(0, crashed=False, error=0.1),
        flight(1, crashed=False, error=0.3),
        flight(2, crashed=True, error=9.0),
    ]
    (row,) = rows(found, task="hover", setting=Scenario())
    assert (row["n"], row["crashes"]) == (3, 1)
    assert row["mean"] == pytest.approx(0.2)
    assert row["std"] == pytest.approx(np.std([0.1, 0.3], ddof=1))
    assert cell(row) == "0.200 ± 0.141, 1 of 3 crashed"
    (row,) = rows(found[2:], task="hover", setting=Scenario())
    assert (row["mean"], row["std"], cell(row)) == (None, None, "crashed, 1 of 1")


def test_a_picture_with_crashes_and_without_adapted_flights(tmp_path):
    found = [flight(0, crashed=False, error=0.1), flight(1, crashed=True, error=3.0)]
    assert all(path.exists() for path in picture(found, presets.load("fast"), "large", Scenario(), tmp_path))


@pytest.mark.usefixtures("optax_promotion")
def test_the_readme_example_runs(folder, monkeypatch, capsys):
    """The Python of the README, as printed, on a shorter flight."""
    text = (Path(__file__).parents[2] / "README.md").read_text()
    (code,) = re.findall(r"```python\n(.*?)```", text, re.S)
    monkeypatch.chdir(folder)
    exec(code.replace("ticks=1500", "ticks=175"), {})  # past the first fit of the residual
    assert "Event(" in capsys.readouterr().out


def test_help_of_every_command(folder):
    for command in ("pretrain", "fly", "demo", "bench", "reproduce", "doctor"):
        assert "--help" in retrim(command, "--help", cwd=folder)


def test_doctor(folder):
    assert "right" in retrim("doctor", cwd=folder)


def test_demo_and_reproduce_at_reduced_size(folder):
    out = retrim("demo", "--seconds", "3", "--starts", "1", "--out", "d", cwd=folder)
    assert "adapted in flight" in out
    results = json.loads((folder / "d" / "results.json").read_text())
    assert [(r["disturbance"], r["method"]) for r in results["rows"]] == [
        (level, method) for level in ("none", "small", "large") for method in ("base", "full")
    ]
    assert all((folder / "d" / f"hover_{level}.png").exists() for level in ("none", "small", "large"))


def interrupted(words, cwd, after):
    """Run, send Ctrl-C once the output shows ``after``, return exit code and output."""
    listening = (
        "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler); "  # whoever runs the tests
    )
    code = f"{listening} from retrim.cli import main; sys.argv = ['retrim', *{words!r}]; main()"
    process = subprocess.Popen(
        [sys.executable, "-u", "-c", code],
        cwd=cwd,
        env={**ENVIRONMENT, "FORCE_COLOR": "1", "TERM": "xterm"},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
    )
    seen = b""
    deadline = time.monotonic() + 120
    while after not in seen and time.monotonic() < deadline:
        seen += process.stdout.read1(4096)
    process.send_signal(signal.SIGINT)
    rest, _ = process.communicate(timeout=60)
    return process.returncode, (seen + rest).decode()


def test_ctrl_c_keeps_what_was_trained(folder):
    words = "pretrain", "hover", "--config", "small.toml", "--epochs", "100000", "--out", "cut"
    code, out = interrupted(words, folder, b"loss ")
    assert code == 130, out
    assert "Traceback" not in out
    results = json.loads((folder / "cut" / "results.json").read_text())
    assert results["interrupted"]
    assert 0 < len(results["losses"]) < 100000
    retrim("fly", "--policy", "cut", "--seconds", "3", "--adapt", "none", "--out", "c", cwd=folder)


def test_ctrl_c_keeps_what_was_flown(folder):
    words = "fly", "--policy", "p", "--seconds", "20", "--starts", "40", "--adapt", "none", "--out", "half"
    code, out = interrupted(words, folder, b" of 40 flights")
    assert code == 130, out
    assert "Traceback" not in out
    results = json.loads((folder / "half" / "results.json").read_text())
    assert results["interrupted"]
    assert 0 < results["rows"][0]["n"] < 40
    assert (folder / "half" / "hover_large.png").exists()


@pytest.mark.usefixtures("optax_promotion")
def test_spans_of_disturbances():
    def found(name, seconds=30.0):
        return [(s.start, s.end, s.label) for s in spans(name, (0.0, 0.0, 1.0), seconds)]

    assert found("none") == []
    assert found("large") == [(0.0, 30.0, "pushed by +2 m/s² per axis")]
    first, second, third = found("reversing", 40.0)
    assert (first[2], second[2]) == ("pushed by +0.5 m/s² per axis", "pushed by -0.5 m/s² per axis")
    assert (second[0], third[0], third[1]) == (pytest.approx(15.0, abs=0.1), pytest.approx(30.0, abs=0.1), 40.0)
    assert found("pickup") == [(8.0, 20.0, "70 g of load")]
    assert found("wind+weak-rotor") == [(0.0, 30.0, "wind of 4.0 m/s; rotors at 90, 100, 100, 100 %")]
    assert found("gusts") == [(0.0, 30.0, "gusts")]
