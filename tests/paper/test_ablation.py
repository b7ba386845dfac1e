"""The ablation: every row is one change that can be flown."""

import pytest

from retrim.config import Setup, changed
from retrim.config import named_presets as presets
from retrim.config.loading import dump
from retrim.config.methods import find_method
from retrim_paper.ablation_options import CONTROL, OFF, ON


@pytest.mark.parametrize(("task", "kind"), [(task, kind) for task in OFF for kind in ("retrim", "paper")])
def test_every_row_is_one_change_of_its_preset(task, kind):
    preset = presets.PRESETS[f"{task}/{kind}"]
    each = OFF[task] if kind == "retrim" else ON[task]
    setup = [(changed(preset, **lever.changes), lever.method) for lever in (*CONTROL, *each)]
    for one, method in setup:
        find_method(method)
        Setup.from_preset(one)
    assert setup.count((preset, "full")) == 1
    assert len({(dump(one), method) for one, method in setup}) == len(setup)
    assert len({lever.label for lever in (*CONTROL, *each)}) == len(setup)
