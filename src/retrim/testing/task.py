"""Conformance suite for tasks."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import random

from ..physics.state import Command, State
from ..tasks.observation import AbstractObservation
from ..tasks.task import AbstractTask
from .laws import close, require, shapes


def check_task(task: AbstractTask, *, starts: int = 16) -> None:
    """Check a task.

    Args:
        task: Task to check.
        starts: Number of random starts to check.

    Raises:
        AssertionError: A law is broken.
    """
    keys = random.split(random.key(0), starts)
    reset = jax.jit(jax.vmap(task.reset))
    x0, again = reset(keys), reset(keys)
    require(all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(x0)), "starts are finite")
    close(x0.x.p, again.x.p, 0.0, "a start follows from its key")
    require(starts < 2 or not np.array_equal(x0.x.p[0], x0.x.p[1]), "starts differ")
    require(not bool(jax.jit(jax.vmap(task.terminated))(x0.t, x0.x).any()), "no start is terminated")
    one = jax.tree.map(lambda leaf: leaf[0], x0)
    u = Command.hover()
    reward, slopes = _slopes(task, one.t, one.x, u)
    require(jnp.shape(reward) == (), "the reward is a scalar")
    require(
        all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((reward, slopes))), "reward and gradient are finite"
    )
    require(any(np.abs(leaf).max() > 0 for leaf in jax.tree.leaves(slopes)), "the reward has a gradient")
    bad_state = State(jnp.full(3, jnp.nan), one.x.R, one.x.v)
    require(bool(task.terminated(one.t, bad_state)), "a state that is not finite is terminated")
    away = State(one.x.p + 1e6, one.x.R, one.x.v)
    require(bool(task.terminated(one.t, away)), "a vehicle 1000 km away is terminated")
    require(float(task.error(one.t, one.x)) >= 0.0, "the error is not negative")
    require(task.home().shape == (3,) and task.target(one.t).shape == (3,), "home and target are positions")
    require(task.dt > 0 and task.horizon > 0, "dt and horizon are positive")
    off = float(task.error(one.t, State.at(task.target(one.t))))
    require(abs(off) < 1e-3, "the error at the target is zero")
    for observation, name in ((task.observation, "training"), (task.observation_in_flight, "flight")):
        memory, (o, later) = _observe(observation, one.t, one.x, u)
        require(o.shape == (observation.size,), f"the observation of {name} has its stated size")
        require(bool(np.isfinite(o).all()), f"the observation of {name} is finite")
        require(shapes(memory) == shapes(later), f"the memory of the observation of {name} keeps its shapes")
    require(
        task.observation.size == task.observation_in_flight.size, "training and flight observe equally many numbers"
    )


@eqx.filter_jit
def _slopes(task: AbstractTask, t: Any, x: State, u: Command) -> Any:
    return jax.value_and_grad(lambda x, u: task.reward(t, x, u), argnums=(0, 1))(x, u)


@eqx.filter_jit
def _observe(observation: AbstractObservation[Any], t: Any, x: State, u: Command) -> Any:
    memory = observation.init(x)
    return memory, observation(memory, t, x, u)
