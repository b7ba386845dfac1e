"""What a command is asked to fly: weights, preset and reference, from files and names, checked against each other."""

from pathlib import Path

from ..adapt.learner import LearnerState
from ..config.presets import Preset
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
