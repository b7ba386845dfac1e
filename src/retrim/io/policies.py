"""Reads and writes files for policies with their presets, and for a flight's learned state."""

import logging
from collections.abc import Collection
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import random
from jaxtyping import Array, Float

from ..adapt.learner_state import LearnerState
from ..config.loading import dump, missing_defaults, parse
from ..config.presets import Preset
from ..config.setup import Setup
from ..config.trust import check_trust
from ..control.controller import AbstractController
from ..control.lora import LoraPolicy
from ..control.policy import AbstractPolicy
from ..errors import CheckpointError, ConfigError, MessageError, one_line
from ..physics.state import State
from ..tasks.observation import AbstractObservation
from ..transport import wire
from .checkpoint import NETWORK, architecture, lora_header, lora_like, policy_like, read_policy, write_policy
from .files import read_bounded, write_whole
from .releases import newer_release, this_release
from .sanity import check_policy, check_size

LOG = logging.getLogger(__name__)
LARGEST_NUMBER = 1e12  # largest number in a resumed learner's state


def save_policy(path: str | Path, policy: AbstractPolicy, preset: Preset) -> None:
    """Write a policy together with its preset.

    Args:
        path: The file; its folder is created if necessary.
        policy: Policy to write.
        preset: Preset with which the policy is flown.

    Raises:
        OSError: The file cannot be written.
    """
    write_policy(path, policy, {"preset": dump(preset), "task": preset.task})


def load_policy(path: str | Path, *, trust: Collection[str] = ()) -> tuple[AbstractPolicy, Preset]:
    """Read a policy and its preset from a file, or from a folder that contains ``policy.safetensors``.

    Args:
        path: The file or folder.
        trust: Python names that the preset may refer to, for example ``mine:task``; they are imported.

    Raises:
        CheckpointError: The file is missing, truncated, damaged or of a different kind, its weights are not finite, or
            its preset cannot be used, does not fit the weights, or names Python code that is not trusted.
    """
    policy, header = read_policy(path, lambda header: _network_like(header, str(path), trust))
    setup = _setup(header, architecture(policy), str(path), trust)
    check_policy(policy, source=str(path), observation=np.asarray(_observe_at_rest(setup)))
    return policy, setup.preset


def save_learner_state(path: str | Path, state: LearnerState, preset: Preset) -> None:
    """Write a flight's learned state: the policy, the residual and the optimiser states, with the preset.

    Args:
        path: The file; its folder is created if necessary.
        state: The learner's state, for example an adaptive pilot's ``pilot.state``.
        preset: Preset of the flight.

    Raises:
        OSError: The file cannot be written.
    """
    policy = state.policy.policy
    low_rank = lora_header(policy) if isinstance(policy, LoraPolicy) else {}
    about = {"preset": dump(preset), "architecture": architecture(policy.merged()), **low_rank}
    about["version"] = this_release()
    write_whole(Path(path), wire.pack(state, kind="learnt", about=about))


def load_learner_state(path: str | Path, *, trust: Collection[str] = ()) -> tuple[LearnerState, Preset]:
    """Read a flight's learned state, to continue from it.

    Args:
        path: The file.
        trust: Python names that the preset may refer to, for example ``mine:task``; they are imported.

    Raises:
        CheckpointError: The file is missing, truncated, damaged or of a different kind, or its preset cannot be used,
            does not fit the learned state, or names Python code that is not trusted.
    """
    path = Path(path)
    data = read_bounded(path, "`retrim fly --out DIR` makes a learner_state.safetensors")
    try:
        header = wire.describe(data, kind="learnt", source=str(path))
        setup = _setup(header, header.get("architecture", ""), str(path), trust)
        policy = _policy_like(header, setup, str(path))
        like = jax.eval_shape(lambda policy: setup.learner.init(policy, random.key(0)), policy)
        state = wire.unpack(data, like, kind="learnt", source=str(path))
    except (MessageError, ConfigError) as error:
        raise CheckpointError(str(error)) from error
    check_size(state, source=str(path), largest=LARGEST_NUMBER)
    check_policy(state.policy.policy.merged(), source=str(path), observation=np.asarray(_observe_at_rest(setup)))
    if not np.isfinite(np.asarray(_command_at_rest(setup.controller(state), setup.flight_task.home()))).all():
        raise CheckpointError(f"{path}: its command at hover is not finite; the learner state cannot be flown")
    return state, setup.preset


def _policy_like(header: dict[str, str], setup: Setup, source: str) -> AbstractPolicy | LoraPolicy:
    """Return the shapes of the policy in a learner state."""
    if header.get("architecture", "") == NETWORK:
        return _shapes(setup)
    base = policy_like(header.get("architecture", ""), source=source)
    return lora_like(base, header, source=source) if "ranks" in header else base


def _network_like(header: dict[str, str], source: str, trust: Collection[str]) -> AbstractPolicy:
    """Return the shapes of a policy that is not a perceptron."""
    return _shapes(_setup(header, NETWORK, source, trust))


def _shapes(setup: Setup) -> AbstractPolicy:
    shapes: AbstractPolicy = eqx.filter_eval_shape(setup.new_policy, random.key(0))
    return shapes


def _setup(header: dict[str, str], sizes: str, source: str, trust: Collection[str]) -> Setup:
    """Return the set-up for a header's preset, after a check against the weights' architecture."""
    try:
        preset = parse(header.get("preset", ""), source=f"{source}, header, preset")
        check_trust(preset, trust, source=source)
        setup = Setup.from_preset(preset)
    except ConfigError as error:
        if newer := newer_release(header):
            raise CheckpointError(
                f"{source}: written by a newer release ({newer}; this one is {this_release()}), and cannot be used: "
                f"{error}"
            ) from error
        raise CheckpointError(str(error)) from error
    if absent := missing_defaults(preset, header["preset"]):
        defaults = ", ".join(f"{name} = {value!r}" for name, value in absent.items())
        LOG.warning(one_line(f"{source}: written by an earlier release; missing keys have their defaults: {defaults}"))
    expected = "-".join(map(str, (setup.env.task.observation.size, *preset.pretrain.hidden_sizes, 4)))
    if preset.pretrain.network != "mlp":
        expected = architecture(_shapes(setup))
    if sizes != expected:
        raise CheckpointError(f"{source}: architecture {sizes}, but its preset {preset.name!r} needs {expected}")
    return setup


def _observe_at_rest(setup: Setup) -> Float[Array, " o"]:
    """Return the observation for a vehicle that has been at rest at home."""
    observation_at_rest: Float[Array, " o"] = _observe(setup.env.task.observation, setup.env.task.home())
    return observation_at_rest


@eqx.filter_jit
def _observe(observation: AbstractObservation[Any], home: Float[Array, "3"]) -> Float[Array, " o"]:
    return observation.at_rest(State.at(home))


@eqx.filter_jit
def _command_at_rest(controller: AbstractController[Any], home: Float[Array, "3"]) -> Float[Array, "4"]:
    x = State.at(home)
    u, _ = controller(controller.init(x), jnp.zeros_like(home[0]), x)
    return u.vector()
