"""``retrim pretrain``."""

from pathlib import Path
from typing import Literal

import tyro

from .. import build, presets
from ..checkpoint import save_policy
from .session import Stopwatch, console, run_folder, write_results
from .training import nominal_error, train

DEFAULT = {"hover": "fast", "track": "track", "vision": "vision"}


def pretrain(
    task: tyro.conf.Positional[Literal["hover", "track", "vision"]],
    preset: str | None = None,
    reference: str | None = None,
    config: Path | None = None,
    epochs: int | None = None,
    envs: int | None = None,
    seed: int = 0,
    out: Path | None = None,
) -> int:
    """Train a policy from scratch in the nominal model and save it.

    Args:
        task: What the policy learns.
        preset: hover: fast (by default), released or paper; track: track (by default) or track-paper.
        reference: What to track: circle, figure8, star, a CSV file of t, x, y, z[, yaw], or a family, as circle+star.
        config: TOML file that overlays the preset, for example with a table [pretrain].
        epochs: Optimiser steps, instead of the preset's.
        envs: Starts per epoch, instead of the preset's.
        seed: Seed of the initial weights and of the starts.
        out: Folder for policy.safetensors and results.json; a new one under runs/ by default.
    """
    watch = Stopwatch()
    settings = presets.load(preset or DEFAULT[task], config)
    if settings.task != task:
        raise presets.PresetError(f"preset {settings.name!r} is for {settings.task}, not for {task}")
    if reference is not None:
        settings = presets.changed(settings, reference=reference)
    if task == "track":
        build.reference(settings.reference)  # a wrong name is refused before anything else happens
    changes = {name: value for name, value in (("epochs", epochs), ("envs", envs)) if value is not None}
    settings = presets.changed(settings, pretrain=changes)
    policy, losses, interrupted = train(settings, seed)
    if not losses:
        console.print("interrupted before the first epochs were done; nothing was saved")
        return 130
    folder = run_folder(out, "pretrain")
    save_policy(folder / "policy.safetensors", policy, settings)
    error = nominal_error(settings, policy)
    row = {
        "task": task,
        "preset": settings.name,
        "epochs": len(losses),
        "envs": settings.pretrain.envs,
        "loss": losses[-1],
        "nominal_error_m": error,
    }
    write_results(folder, seeds=[seed], watch=watch, rows=[row], interrupted=interrupted, losses=losses)
    console.print(f"{task} error in its own model: {1000 * error:.1f} mm after {len(losses)} epochs")
    console.print(f"compiling {watch.compile_s:.1f} s, all else {watch.total_s - watch.compile_s:.1f} s")
    console.print(f"[bold]{folder / 'policy.safetensors'}[/]", soft_wrap=True)
    return 130 if interrupted else 0
