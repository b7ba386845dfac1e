"""``retrim pretrain``."""

import threading
from collections.abc import Callable
from pathlib import Path

import tyro

from ..config.loading import changed, load, overlaid
from ..config.presets import PRESETS, Preset
from ..config.setup import Setup
from ..config.tasks import find_task
from ..config.vehicle_file import VehicleSpec
from ..config.vehicles import vehicle_from
from ..errors import CheckpointError, ConfigError
from ..experiments.run import INTERRUPTED, Run
from ..experiments.training import nominal_error, train
from ..io.trained import save_policy
from .console import RichReporter, console, show_paths
from .overlay import table_of


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
    out: Path | None = None,
) -> Callable[[threading.Event], int]:
    """Train a policy from scratch in the nominal model and save it.

    Args:
        task: What the policy learns: hover, track, vision, or module:name of a task of your own.
        preset: Preset to train with, as hover/fast or hover/paper; by default the task's own.
        vehicle: Vehicle to train for: small, large, kingfisher, a vehicle file, as my_quad.toml, or module:name.
        reference: What to track: circle, figure8, star, a CSV file, module:name, or a family, as circle+star.
        residual: Residual model of later adaptation: ensemble, or module:name.
        config: TOML file that overlays the preset, for example with a table [pretrain].
        updates: Optimiser steps, instead of the preset's.
        envs: Starts per step, instead of the preset's.
        seed: Seed of the initial weights and of the starts, 0 to 4294967295.
        out: Folder for policy.safetensors and results.json; a new one under runs/ by default.
    """
    return lambda stop: _pretrain(
        _preset(task, preset, vehicle, reference, residual, config, updates, envs), checked_seed(seed), out, stop
    )


def _preset(
    task: str,
    preset: str | None,
    vehicle: str | None,
    reference: str | None,
    residual: str | None,
    config: Path | None,
    updates: int | None,
    envs: int | None,
) -> Preset:
    entry = find_task(task)
    name = preset or entry.default_preset
    chosen = load(f"{task}/{name}" if "/" not in name and f"{task}/{name}" in PRESETS else name)
    if chosen.task != task:
        if ":" not in task or chosen.task != "hover":
            raise ConfigError(f"preset {chosen.name!r} is for {chosen.task}, not for {task}")
        chosen = changed(chosen, task=task, name=f"{task} on {chosen.name}")
    if config is not None:
        chosen = overlaid(chosen, config)
    if reference is not None:
        if not entry.has_reference:
            raise ConfigError(f"--reference {reference}: a {task} policy follows none")
        chosen = changed(chosen, track={**table_of(chosen.track), "reference": reference})
    changes: dict[str, object] = {k: v for k, v in (("num_updates", updates), ("num_envs", envs)) if v is not None}
    chosen = changed(chosen, pretrain=changes)
    if residual is not None:
        chosen = changed(chosen, adapt={"residual": residual})
    if vehicle is not None:
        found = vehicle_from(vehicle)
        chosen = changed(chosen, vehicle=table_of(found) if isinstance(found, VehicleSpec) else found)
    return chosen


def checked_seed(seed: int) -> int:
    """Return the seed.

    Raises:
        ConfigError: It is negative or does not fit 32 bits.
    """
    if not 0 <= seed < 2**32:
        raise ConfigError(f"--seed {seed}: must be 0 to {2**32 - 1}")
    return seed


def _pretrain(preset: Preset, seed: int, out: Path | None, stop: threading.Event) -> int:
    setup = Setup.of(preset)
    run, reporter = Run("pretrain", out, stop=stop), RichReporter()
    trained = train(setup, seed, reporter=reporter, stop=stop)
    if not trained.losses:
        console.print("interrupted before the first steps were done; nothing was saved")
        return INTERRUPTED
    path = run.folder / "policy.safetensors"
    try:
        save_policy(path, trained.policy, preset)
    except OSError as error:
        path = Run("pretrain", None).folder / "policy.safetensors"
        save_policy(path, trained.policy, preset)
        raise CheckpointError(f"{run.folder}: {error.strerror}; the policy was saved as {path} instead") from error
    row = {
        "task": preset.task,
        "preset": preset.name,
        "updates": len(trained.losses),
        "envs": preset.pretrain.num_envs,
        "loss": trained.losses[-1],
    }
    run.write_results([row], seeds=[seed], losses=trained.losses)
    if not run.interrupted:
        row["nominal_error_m"] = error_m = nominal_error(setup, trained.policy)
        run.write_results([row], seeds=[seed], losses=trained.losses)
        name = preset.task.rpartition(":")[2]
        console.print(f"{name} error in its own model: {1000 * error_m:.1f} mm after {len(trained.losses)} steps")
    console.print(run.watch.sentence())
    show_paths([path])
    return run.exit_code
