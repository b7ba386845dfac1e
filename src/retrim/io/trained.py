"""Policies with the preset that says how to fly them, and what a flight has learnt, as files."""

from collections.abc import Collection
from pathlib import Path

import jax
from jax import random

from ..adapt.learner import LearnerState
from ..config.loading import dump, parse
from ..config.presets import Preset
from ..config.setup import Setup
from ..config.trust import check_trust
from ..control.lora import LoraPolicy
from ..control.policy import Policy
from ..errors import CheckpointError, ConfigError, MessageError
from ..transport import wire
from .checkpoint import architecture, lora_header, lora_like, policy_like, read_policy, write_policy
from .files import read_bounded, write_whole


def save_policy(path: str | Path, policy: Policy, preset: Preset) -> None:
    """Write a policy and the preset that it was trained with.

    Args:
        path: The file; its folder is made if need be.
        policy: What to write.
        preset: It says how to fly the policy.

    Raises:
        OSError: The file cannot be written.
    """
    write_policy(path, policy, {"preset": dump(preset), "task": preset.task})


def load_policy(path: str | Path, *, trust: Collection[str] = ()) -> tuple[Policy, Preset]:
    """Read a policy and its preset from a file, or from a folder that holds ``policy.safetensors``.

    Args:
        path: The file.
        trust: Python names that its preset may hold, as ``mine:task``; they are imported.

    Raises:
        CheckpointError: The file is missing, truncated, damaged or of another kind, its weights are not finite, or
            its preset cannot be used, does not fit the weights, or names Python code that is not trusted.
    """
    policy, header = read_policy(path)
    return policy, _preset(header, architecture(policy), str(path), trust)


def save_learnt(path: str | Path, state: LearnerState, preset: Preset) -> None:
    """Write what a flight has learnt: policy, residual and optimiser states, with the preset.

    Args:
        path: The file; its folder is made if need be.
        state: As ``pilot.state`` of an adaptive pilot.
        preset: Preset of the flight.

    Raises:
        OSError: The file cannot be written.
    """
    policy = state.policy.policy
    low_rank = lora_header(policy) if isinstance(policy, LoraPolicy) else {}
    about = {"preset": dump(preset), "architecture": architecture(policy.merged()), **low_rank}
    write_whole(Path(path), wire.pack(state, kind="learnt", about=about))


def load_learnt(path: str | Path, *, trust: Collection[str] = ()) -> tuple[LearnerState, Preset]:
    """Read what a flight has learnt, to go on from it.

    Args:
        path: The file.
        trust: Python names that its preset may hold, as ``mine:task``; they are imported.

    Raises:
        CheckpointError: The file is missing, truncated, damaged or of another kind, or its preset cannot be used, does
            not fit what was learnt, or names Python code that is not trusted.
    """
    path = Path(path)
    data = read_bounded(path, "`retrim fly --out DIR` makes a learnt.safetensors")
    try:
        header = wire.describe(data, kind="learnt", source=str(path))
        preset = _preset(header, header.get("architecture", ""), str(path), trust)
        base = policy_like(header.get("architecture", ""), source=str(path))
        policy: Policy | LoraPolicy = lora_like(base, header, source=str(path)) if "ranks" in header else base
        learner = Setup.of(preset).learner
        like = jax.eval_shape(lambda policy: learner.init(policy, random.key(0)), policy)
        return wire.unpack(data, like, kind="learnt", source=str(path)), preset
    except (MessageError, ConfigError) as error:
        raise CheckpointError(str(error)) from error


def _preset(header: dict[str, str], sizes: str, source: str, trust: Collection[str]) -> Preset:
    """The preset of a header, checked against the architecture of the weights."""
    try:
        preset = parse(header.get("preset", ""), source=f"{source}, header, preset")
        check_trust(preset, trust, source=source)
        wanted = Setup.of(preset).env.task.observation.size
    except ConfigError as error:
        raise CheckpointError(str(error)) from error
    expected = "-".join(map(str, (wanted, *preset.pretrain.hidden_sizes, 4)))
    if sizes != expected:
        raise CheckpointError(f"{source}: architecture {sizes}, but its preset {preset.name!r} needs {expected}")
    return preset
