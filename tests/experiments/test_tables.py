"""Tables at reduced size, and what stands in them."""

import json
import subprocess
import sys

import numpy as np
import pytest
from test_commands import ENVIRONMENT

from retrim.adapt import Log
from retrim.config.presets import Adapt, ConfigError
from retrim.experiments.fleet import Flight, Plan
from retrim.experiments.tables.reversing import METHODS, _errors, _lines, _moments, reversing
from retrim.experiments.tables.tracking import tracking
from retrim.experiments.tables.vision import vision

TABLE = """
from pathlib import Path
from retrim import presets
from retrim.cli.reproduce.task_table import Block, table

small = {"pretrain": {"hidden": (32, 32), "epochs": 60, "envs": 8, "horizon": 60}}
small["adapt"] = {"window": 50, "improve_charge": 0.3, "epochs": 2, "envs": 2, "iters": 10, "improve_every": 1.5}
ours = presets.changed(presets.load("track"), reference="circle", **small)
blocks = [Block("seen ahead", ours, "circle", ("base", "lora"), paper=(("base", ("1", "2", "3")),))]
raise SystemExit(table("tracking", ["# About"], blocks, plant="simple", seconds=3.0, starts=2, seed=0, folder=Path()))
"""


def test_a_table_of_tracking(tmp_path):
    ran = subprocess.run(
        [sys.executable, "-c", TABLE], cwd=tmp_path, env=ENVIRONMENT, capture_output=True, text=True, check=False
    )
    assert ran.returncode == 0, ran.stderr
    text = (tmp_path / "tracking.md").read_text()
    assert text.startswith("# About\n")
    assert text.count("| ... cross-track |") == 2
    assert "| paper, base | 1 | 2 | 3 |" in text
    results = json.loads((tmp_path / "tracking.json").read_text())
    found = [(row["disturbance"], row["method"], row["n"], row["reference"]) for row in results["rows"]]
    assert found == [(d, m, 2, "circle") for d in ("none", "small", "large") for m in ("base", "lora")]
    for row in results["rows"]:
        assert row["crashes"] == 2 or f"{row['mean']:.3f} ± {row['std']:.3f}" in text
    assert (tmp_path / "tracking_track_circle_circle.png").stat().st_size > 10_000


def test_errors_are_read_around_reversals_and_updates():
    """A reversal every 15 s; updates start every 5 s and fly a second later."""
    moments = _moments(Adapt(), 60.0)
    np.testing.assert_allclose(moments, [[15, 16, 21, 26, 30], [30, 31, 36, 41, 45], [45, 46, 51, 56, 60]])
    t = 0.02 * np.arange(3001)
    still = np.zeros((3001, 3)), np.tile(np.eye(3), (3001, 1, 1)), np.zeros((3001, 3)), np.zeros((3001, 4))
    ramp = Flight(Plan("reversing", "full", 0), Log(t, *still, crashed=False), error=t, events=())
    # fifty ticks, that of the moment last
    np.testing.assert_allclose(_errors(ramp, moments), moments - 0.49, atol=1e-9)
    lines = _lines({"base": [], "full": [_errors(ramp, moments)] * 2}, moments)
    assert len(lines) == 2 + 3 * len(METHODS)
    assert lines[2] == "| reversed at 15 s, base policy | - |"
    assert lines[3].startswith("| reversed at 15 s, **adapted** | 14.510 ± 0.000 | 15.510 ± 0.000 |")


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda out: reversing("track", out=out), "needs a preset for hover"),
        (lambda out: reversing(seconds=20.0, out=out), "needs a preset for hover, 30 s and 1 start"),
        (lambda out: tracking(preset=("slow",), out=out), "no preset 'slow'"),
        (lambda out: vision(preset=("slow",), out=out), "no preset 'slow'"),
    ],
)
def test_wrong_input_is_refused_before_anything_happens(make, message, tmp_path):
    with pytest.raises(ConfigError, match=message):
        make(tmp_path / "out")
    assert not list(tmp_path.iterdir())
