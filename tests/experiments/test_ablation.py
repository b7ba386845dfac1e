"""The ablation: every lever is one change that can be flown, and the table has a row for each."""

import importlib
import json

import pytest

from commands import retrim
from helpers import brief_preset
from retrim.config import Setup, changed, levers
from retrim.config import named_presets as presets
from retrim.config.levers import CONTROL, OFF, ON
from retrim.config.methods import find_method


@pytest.mark.parametrize(("task", "kind"), [(task, kind) for task in OFF for kind in ("retrim", "paper")])
def test_every_lever_is_one_change_of_its_preset(task, kind):
    preset = presets.PRESETS[f"{task}/{kind}"]
    each = OFF[task] if kind == "retrim" else ON[task]
    made = [(changed(preset, **lever.changes), lever.method) for lever in (*CONTROL, *each)]
    for one, method in made:
        find_method(method)
        Setup.of(one)
    assert made.count((preset, "full")) == 1
    assert len({(str(one), method) for one, method in made}) == len(made)
    assert len({lever.label for lever in (*CONTROL, *each)}) == len(made)


def test_the_ablation_by_its_command(tmp_path, as_a_user, monkeypatch):
    for name in ("hover/retrim", "hover/paper"):
        monkeypatch.setitem(presets.PRESETS, name, brief_preset())
    monkeypatch.setitem(levers.OFF, "hover", (OFF["hover"][0], levers.Lever("slow", {"adapt": {"update_every": 2.0}})))
    monkeypatch.setitem(levers.ON, "hover", (ON["hover"][0],))
    table = importlib.import_module("retrim.experiments.tables.ablation")  # the package has a function of that name
    monkeypatch.setitem(table.DISTURBANCES, "hover", ("none", "step"))
    out = retrim("reproduce", "ablation", "--starts", "1", "--seconds", "6", "--out", "a", cwd=tmp_path)
    text = (tmp_path / "a" / "ablation.md").read_text()
    assert "| slow |" in out
    assert text.count("| base policy |") == 2
    assert "| lever | none | step |" in text
    rows = json.loads((tmp_path / "a" / "ablation.json").read_text())["rows"]
    assert len(rows) == 2 * (4 + 3)
    assert {row["lever"] for row in rows} == {
        "base policy",
        "base policy + integral action",
        "all levers",
        "slow",
        "as printed",
    }
    assert all(row["n"] == 1 and (row["crashes"] or row["mean"] >= 0.0) for row in rows)
    assert out.count("pretraining") >= 1
