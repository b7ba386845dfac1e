"""Compares the cost of each method: the paper's compute and sample figures with ours."""

import tempfile
from pathlib import Path
from typing import Any

from jax import random

from retrim.config.baselines import baseline_request
from retrim.config.setup import Setup
from retrim.control.baselines import BASELINES
from retrim.errors import ConfigError
from retrim.evaluation.compute_cost import decision_s, updates
from retrim.evaluation.study import table_presets
from retrim.runkit.document import Document, TableSection
from retrim.runkit.reporter import Reporter
from retrim.runkit.run import Run
from retrim.runkit.stopwatch import Stopwatch
from retrim.runkit.training import train

from ..datt.controller import DattNet
from ..datt.method import datt_of
from ..datt.training import DATT_STEPS, check_period, check_steps, round_steps, train_datt

INTRO = """\
Made by `retrim reproduce efficiency`. Steps are control ticks of one simulated vehicle. Training: its time without
compiling, and the time of compiling, which depends on the compile cache of the machine. An update in flight: a
fit of the residual on the window, and a re-training of the policy, each the median of nine runs on all cores of an idle
process; the window is all the flight data that an update needs. A decision: the median of 200, in one call from Python.
The paper's figures are from a workstation with a large GPU."""
PAPER = (
    ("the paper's, pretraining", "4,500,000", "about 15 s", "", "45,000", "about 2 s + 1.5 s", "2 s (hover)", ""),
    ("DATT, the paper's", "20,000,000", "about 2 h", "", "none", "", "", ""),
)
COLUMNS = (
    "method", "steps of training", "training [s]", "compiling [s]", "steps of an update", "fit + update [s]",
    "window of flight [s]", "decision [ms]",
)  # fmt: skip


def efficiency(
    run: Run,
    reporter: Reporter,
    *,
    presets: tuple[str, ...] = ("hover/retrim", "hover/fast", "hover/paper"),
    datt_steps: int = DATT_STEPS,
) -> None:
    """Cost of each method: the steps and time for training, for an update in flight, and for one decision.

    Args:
        run: Folder for efficiency.md and efficiency.json.
        reporter: Receives progress and the section.
        presets: Presets for hover, to train and time.
        datt_steps: Number of training steps for DATT.
    """
    bases = table_presets(presets, "hover", seeds=(0,), starts=1, seconds=1.0)
    if not bases:
        raise ConfigError("--presets: name at least one preset for hover")
    check_steps(datt_steps)
    check_period(bases[0])
    document = Document(run, "efficiency", "What each method costs", INTRO, [0], reporter)
    rows: list[dict[str, Any]] = []
    for preset in bases:
        if run.interrupted:
            break
        setup, watch = Setup.from_preset(preset), Stopwatch()
        policy, losses = train(setup, 0, reporter=reporter, stop=run.stop)
        p, compiling = preset.pretrain, watch.compile_s
        training_rows = {
            "method": preset.name, "steps": len(losses) * p.num_envs * p.horizon,
            "training_s": watch.total_s - compiling, "training_compile_s": compiling,
        }  # fmt: skip
        if run.interrupted:
            break
        reporter.say(f"{preset.name}: timing updates")
        with run.interruptible():
            flies = setup.controller(setup.learner.init(policy, random.key(0)))
            rows.append({**training_rows, **updates(setup), "decision_s": decision_s(setup, flies)})
            rows.append({"method": f"{preset.name}, LoRA", **updates(setup, lora=True)})
    setup = Setup.from_preset(bases[0])
    for name, baseline in BASELINES.items():
        if run.interrupted:
            break
        with run.interruptible():
            rows.append({"method": name, "decision_s": decision_s(setup, baseline.controller(baseline_request(setup)))})
    if not run.interrupted:
        watch = Stopwatch()
        with tempfile.TemporaryDirectory() as folder:  # always trained anew, even if the run's folder has the network
            afresh = Run("efficiency", Path(folder), stop=run.stop)
            nets: dict[int, DattNet] = train_datt(bases[0], [0], afresh, reporter, steps=datt_steps)
        compiling = watch.compile_s
        if nets:
            rows.append({
                "method": "datt", "steps": round_steps(datt_steps), "training_s": watch.total_s - compiling,
                "training_compile_s": compiling, "decision_s": decision_s(setup, datt_of(setup, nets[0])),
            })  # fmt: skip
    if rows:
        document.add(TableSection(COLUMNS, (*(_line(row) for row in rows), *PAPER)), rows)
    document.write()


def _line(row: dict[str, Any]) -> tuple[str, ...]:
    update = f"{row['fit_s']:.4f} + {row['update_s']:.3f}" if "update_s" in row else ""
    return (
        row["method"],
        f"{row['steps']:,}" if "steps" in row else "",
        f"{row['training_s']:.1f}" if "training_s" in row else "",
        f"{row.get('training_compile_s', row.get('compile_s', 0.0)):.1f}" if "steps" in row or "fit_s" in row else "",
        f"{row['update_steps']:,}" if "update_steps" in row else "",
        update,
        f"{row['window_s']:g}" if "window_s" in row else "",
        f"{1e3 * row['decision_s']:.2f}" if "decision_s" in row else "",
    )
