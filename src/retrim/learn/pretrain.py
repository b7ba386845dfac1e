"""Train a policy from scratch in the nominal model (paper, Sec. IV-A.2)."""

from collections.abc import Iterator
from typing import Any

import equinox as eqx
import jax
import optax
from jax import random
from jaxtyping import Array, Float, Key

from ..control.policy import Policy
from ..physics.dynamics import AbstractDynamics
from ..tasks.task import AbstractTask, Start
from .bptt import PolicyState, bptt


def starts(task: AbstractTask, key: Key[Array, ""], epochs: int, envs: int) -> Start:
    """Random starts, epochs x environments; the key is consumed."""
    return jax.vmap(jax.vmap(task.reset))(random.split(key, (epochs, envs)))


@eqx.filter_jit
def train_chunk(
    state: PolicyState,
    dynamics: AbstractDynamics[Any],
    task: AbstractTask,
    key: Key[Array, ""],
    optimiser: optax.GradientTransformation,
    epochs: int,
    envs: int,
    delay: int,
) -> tuple[PolicyState, Float[Array, " epochs"]]:
    """Train for ``epochs`` epochs on fresh starts; compiled once for the same optimiser, sizes and shapes.

    Training is cut into such chunks, so that progress can be shown and an interrupted run keeps what it has.
    """
    return bptt(state, dynamics, task, starts(task, key, epochs, envs), optimiser=optimiser, delay=delay)


def pretrain(
    policy: Policy,
    dynamics: AbstractDynamics[Any],
    task: AbstractTask,
    key: Key[Array, ""],
    *,
    optimiser: optax.GradientTransformation,
    epochs: int,
    envs: int,
    delay: int = 0,
    chunk: int = 10,
) -> Iterator[tuple[PolicyState, Float[Array, " chunk"]]]:
    """Yield the trained state and the losses of each ``chunk`` epochs; the key is consumed.

    Raises ``ValueError`` if ``epochs`` is not a multiple of ``chunk``, since every chunk runs the same program.
    """
    if epochs % chunk or epochs <= 0:
        raise ValueError(f"epochs = {epochs} must be a positive multiple of {chunk}")
    state = PolicyState(policy, optimiser.init(policy.trained))
    for k in random.split(key, epochs // chunk):
        state, losses = train_chunk(state, dynamics, task, k, optimiser, chunk, envs, delay)
        yield state, losses
