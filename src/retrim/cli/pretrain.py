"""``retrim pretrain``: train a policy from scratch."""

import threading
from collections.abc import Callable
from functools import partial
from pathlib import Path

import tyro

from ..config.limits import check_seeds
from ..config.presets import Preset
from ..config.setup import Setup
from ..runkit.outlet import Outlet
from ..runkit.outputs import write_trained_policy
from ..runkit.run import INTERRUPTED, Run
from ..runkit.training import ground_warning, nominal_error, train
from .arguments import training_preset
from .console import RichReporter, Trust, console, refuse, report_start, show_paths, warn


def pretrain(
    task: tyro.conf.Positional[str],
    preset: str | None = None,
    vehicle: str | None = None,
    reference: str | None = None,
    residual: str | None = None,
    config: Path | None = None,
    updates: int | None = None,
    envs: int | None = None,
    seed: int = 0,
    trust: Trust = (),
    out: Path | None = None,
) -> Callable[[threading.Event], int]:
    """Train a policy from scratch in the nominal model and save it.

    Args:
        task: Task of the policy: hover, track, vision, or module:name of a custom task.
        preset: Preset to train with, such as hover/retrim or hover/paper; by default that of the task.
        vehicle: Vehicle to train for: small, large, kingfisher, a vehicle file such as my_quad.toml, or module:name.
        reference: Reference to track: circle, figure8, star, a CSV file, module:name, or a family such as circle+star.
        residual: Residual model for later adaptation: ensemble, regression, layered, linear, or module:name.
        config: TOML file with values that replace those of the preset, for example a table [pretrain].
        updates: Number of optimiser steps; by default that of the preset.
        envs: Number of starts per step; by default that of the preset.
        seed: Seed of the initial weights and the starts, 0 to 4294967295.
        trust: Python name that a file may contain, such as mine:task; its code is run. Repeat the option for each name.
        out: Folder for policy.safetensors and results.json; by default, a new one under runs/.
    """

    def execute(stop: threading.Event) -> int:
        check_seeds([seed])
        base = training_preset(
            task, preset, config=config, vehicle=vehicle, reference=reference, residual=residual,
            num_updates=updates, num_envs=envs, trust=trust,
        )  # fmt: skip
        return _pretrain(base, seed, out, stop)

    return execute


def _pretrain(preset: Preset, seed: int, out: Path | None, stop: threading.Event) -> int:
    setup = Setup.from_preset(preset)
    run, reporter = report_start(Run("pretrain", out, stop=stop)), RichReporter()
    if warning := ground_warning(setup):
        warn(warning)
    policy, losses = train(setup, seed, reporter=reporter, stop=stop)
    if not losses:
        console.print("interrupted before the first steps were done; nothing was saved")
        return INTERRUPTED
    outlet = Outlet(run.folder)
    write = partial(write_trained_policy, setup=setup, policy=policy, losses=losses, seed=seed)
    path = outlet.write("the policy", lambda folder: write(run.at(folder)))
    with run.interruptible():
        if path is not None and not run.interrupted:
            error_m = nominal_error(setup, policy)
            write(run.at(path.parent), error_m=error_m)
            summary = f"{preset.task} error in its own model: {1000 * error_m:.1f} mm after {len(losses)} steps"
            console.print(summary)
    if run.interrupted:
        console.print(f"interrupted after {len(losses)} steps{'' if path is None else ', which are saved'}")
    console.print(run.watch.sentence())
    show_paths([] if path is None else [path])
    return max((refuse(fault) for fault in outlet.faults), default=run.exit_code)
