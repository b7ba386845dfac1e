"""Pretraining in the nominal model (paper, Sec. IV-A.2)."""

import math
from collections.abc import Iterator

import equinox as eqx
import jax
import optax
from jax import random
from jaxtyping import Array, Float, Key

from ..control.policy import AbstractPolicy
from ..errors import TrainingError
from ..tasks.task import AbstractTask, Start
from .bptt import PolicyState, bptt
from .devices import replicate, shard, suitable_device, to_default_device
from .env import Env

PATIENCE = 10  # consecutive steps without a finite loss; fewer are due to bad starts, which are left out


def random_starts(task: AbstractTask, key: Key[Array, ""], num_updates: int, num_envs: int) -> Start:
    """Return random starts with two leading axes, updates x environments; the key is consumed."""
    return jax.vmap(jax.vmap(task.reset))(random.split(key, (num_updates, num_envs)))


@eqx.filter_jit
def train_chunk(
    state: PolicyState,
    env: Env,
    key: Key[Array, ""],
    optimiser: optax.GradientTransformation,
    num_updates: int,
    num_envs: int,
) -> tuple[PolicyState, Float[Array, " updates"]]:
    """Take ``num_updates`` optimiser steps on fresh starts; compile once for the same optimiser, sizes and shapes.

    Training is divided into such chunks, so that progress can be shown and an interrupted run keeps its results.
    Several devices share the starts of each step.
    """
    starts = shard(jax.vmap(jax.vmap(env.reset))(random.split(key, (num_updates, num_envs))), axis=1)
    return replicate(bptt(state, env, starts, optimiser=optimiser), num_envs)


def pretrain(
    policy: AbstractPolicy,
    env: Env,
    key: Key[Array, ""],
    *,
    optimiser: optax.GradientTransformation,
    num_updates: int,
    num_envs: int,
    chunk: int = 10,
) -> Iterator[tuple[PolicyState, Float[Array, " chunk"]]]:
    """Train a policy from fresh starts.

    Args:
        policy: Policy to start from.
        env: Nominal model, task and delay.
        key: Random key, consumed.
        optimiser: Optimiser of the policy's parameters. A second call with the same object does not recompile.
        num_updates: Number of optimiser steps, a multiple of ``chunk``, since every chunk runs the same program.
        num_envs: Starts per step.
        chunk: Steps between two results.

    Yields:
        The state after each chunk, and the losses of its steps.

    Raises:
        ValueError: ``num_updates`` is not a positive multiple of ``chunk``.
        TrainingError: The loss is not a number in ten consecutive steps or in the last step.
    """
    if num_updates % chunk or num_updates <= 0:
        raise ValueError(f"num_updates = {num_updates} must be a positive multiple of {chunk}")
    state = PolicyState(policy, optimiser.init(policy.params))
    steps, bad = 0, 0
    for k in random.split(key, num_updates // chunk):
        with suitable_device(policy, num_envs):
            state, losses = to_default_device(train_chunk(state, env, k, optimiser, chunk, num_envs))
        for loss in losses.tolist():
            steps, bad = steps + 1, 0 if math.isfinite(loss) else bad + 1
            if bad >= PATIENCE or (bad and steps == num_updates):
                raise TrainingError(
                    f"training: the loss is not a number in steps {steps - bad + 1} to {steps} of {num_updates}, and "
                    f"no policy is kept; check the vehicle's limits, the reward and the learning rate"
                )
        yield state, losses
