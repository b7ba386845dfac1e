"""What a command is asked for: weights, preset and reference, from files and names, checked against each other."""

import dataclasses
from pathlib import Path
from typing import Any

from ..adapt.learner import LearnerState
from ..config.loading import changed, load_for, overlaid
from ..config.presets import Preset
from ..config.tasks import find_task
from ..config.vehicle_file import VehicleSpec
from ..config.vehicles import vehicle_from
from ..control.policy import Policy
from ..errors import ConfigError
from ..io.checkpoint import load_delta
from ..io.trained import load_learnt, load_policy


def loaded(
    policy: Path | None, resume: Path | None, delta: Path | None = None
) -> tuple[Policy, Preset, LearnerState | None]:
    """Return weights, preset, and what an earlier flight learnt.

    Args:
        policy: A policy, or the folder that holds one.
        resume: Instead of a policy: what an earlier flight learnt.
        delta: A low-rank delta to put on the policy.

    Raises:
        ConfigError: There are both or neither, or a delta beside what was learnt.
        CheckpointError: A file cannot be used.
    """
    if (policy is None) == (resume is None):
        raise ConfigError("give either --policy FILE or --resume FILE; `retrim pretrain hover --out h` makes h")
    if resume is not None:
        if delta is not None:
            raise ConfigError("--delta goes with --policy; --resume holds its own")
        state, preset = load_learnt(resume)
        return state.policy.policy.merged(), preset, state
    assert policy is not None
    weights, preset = load_policy(policy)
    return (load_delta(delta, weights).merged() if delta is not None else weights), preset, None


def flown_reference(preset: Preset, name: str | None) -> str | None:
    """Return the reference of a tracking flight; None for another task.

    Args:
        preset: Of the policy.
        name: What was asked for; None for what training follows.

    Raises:
        ConfigError: The policy cannot follow it.
    """
    if preset.track is None:
        if name is not None:
            raise ConfigError(f"--reference {name}: a {preset.task} policy follows none")
        return None
    trained_on = preset.track.reference
    if name is None and "+" in trained_on:
        raise ConfigError(f"the policy was trained on {trained_on}: say which to fly, as --reference circle")
    if name is not None and name != trained_on and preset.track.observation == "state":
        raise ConfigError(
            f"--reference {name}: this policy does not see its reference, and was trained on {trained_on}"
        )
    return name or trained_on


def same_policy(trained: Preset, changed_one: Preset, config: Path) -> Preset:
    """Return ``changed_one``, unless it changes what the weights were trained for.

    Raises:
        ConfigError: It does.
    """
    for name in ("task", "vehicle", "dt", "command_history", "pretrain"):
        before, after = getattr(trained, name), getattr(changed_one, name)
        if before != after:
            shown = (f"{name} = {after!r}, but the policy was trained with {before!r}"
                     if name != "pretrain" else "[pretrain] cannot change for a policy that is trained")  # fmt: skip
            raise ConfigError(f"{config}: {shown}")
    before_sees, after_sees = (p.track and p.track.observation for p in (trained, changed_one))
    if before_sees != after_sees:
        raise ConfigError(
            f"{config}: track.observation = {after_sees!r}, but the policy was trained with {before_sees!r}"
        )
    return changed_one


def asked_preset(
    task: str,
    preset: str | None = None,
    *,
    config: Path | None = None,
    vehicle: str | None = None,
    reference: str | None = None,
    residual: str | None = None,
    **pretrain: int | None,
) -> Preset:
    """Return the preset to train with.

    Args:
        task: Name of a task.
        preset: Name of a preset; by default the task's own.
        config: TOML file on top of it.
        vehicle: Vehicle to train for, on top of both.
        reference: What to track, on top of both.
        residual: Residual model of later adaptation, on top of both.
        **pretrain: Values of the table ``pretrain``, on top of both; None for those that stay.

    Raises:
        ConfigError: A name, key or value does not fit.
    """
    entry = find_task(task)
    chosen = load_for(task, preset or entry.default_preset)
    if config is not None:
        chosen = overlaid(chosen, config)
    if reference is not None:
        if not entry.has_reference:
            raise ConfigError(f"--reference {reference}: a {task} policy follows none")
        chosen = changed(chosen, track={**_table(chosen.track), "reference": reference})
    chosen = changed(chosen, pretrain={name: value for name, value in pretrain.items() if value is not None})
    if residual is not None:
        chosen = changed(chosen, adapt={"residual": residual})
    if vehicle is not None:
        found = vehicle_from(vehicle)
        chosen = changed(chosen, vehicle=_table(found) if isinstance(found, VehicleSpec) else found)
    return chosen


def _table(value: Any) -> dict[str, Any]:
    """A dataclass as a plain dictionary; None as an empty one."""
    return {} if value is None else dataclasses.asdict(value)
