"""Small helpers for many tests: random states, a small task, a small preset."""

import dataclasses
import math
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax, random

from retrim import learn
from retrim.config import changed, load
from retrim.learn import Env, Window
from retrim.learn.pretrain import random_starts as training_starts
from retrim.physics import AbstractSubstepDynamics, ActuatorResponse, Command, PointMass, State, small, so3
from retrim.tasks import Hover, StateObs

GOAL = (0.0, 0.0, 1.0)

BRIEF = {
    "pretrain": {"hidden_sizes": [16, 16], "num_updates": 10, "num_envs": 2, "horizon": 20},
    "adapt": {"window": 20, "fit_every": 0.4, "update_every": 0.6, "fit_latency": 0.1, "update_latency": 0.2,
              "fit_steps": 5, "num_updates": 2, "num_envs": 2},
}  # fmt: skip

# Compiled programs: without jit, each operation would be compiled separately.
residual_targets = eqx.filter_jit(learn.residual_targets)
random_starts = eqx.filter_jit(training_starts)
call = eqx.filter_jit(lambda function, *arguments: function(*arguments))


class CheapModel(AbstractSubstepDynamics[State]):
    """Eq. (1) at 1 kHz, the cheapest model of a plant, without rotors and limits."""

    dt: float = eqx.field(static=True, default=0.02)

    def init(self, x):
        return x

    def state(self, s):
        return s

    def with_state(self, s, x):
        return x

    def substep(self, s, u, effects):
        return PointMass(1e-3).step(s, u, effects.push)


@eqx.filter_jit
def draw_starts(task, key, n):
    """Draw ``n`` starts of a task."""
    return jax.vmap(task.reset)(random.split(key, n))


@jax.jit
def random_state(key, spread=1.0):
    kp, kr, kv = random.split(key, 3)
    return State(spread * random.normal(kp, (3,)), so3.exp(random.normal(kr, (3,))), spread * random.normal(kv, (3,)))


@jax.jit
def random_command(key):
    kc, kw = random.split(key)
    return Command(9.81 + random.normal(kc, ()), random.normal(kw, (3,)))


def hover_task(*, horizon=5, history=0, heading=math.pi, box=5.0, dt=0.02, make=Hover):
    goal = jnp.array(GOAL)
    observation = StateObs(goal, small().omega_max, history)
    return make(goal, observation, jnp.array(box), jnp.array(heading), dt, horizon)


def hover_env(dynamics=None, *, delay_ticks=0, **task):
    """Return a hover task with a model of its tick, by default the point mass."""
    small_task = hover_task(**task)
    delay = jnp.array(delay_ticks * small_task.dt)
    return Env(PointMass(small_task.dt) if dynamics is None else dynamics, small_task, delay)


def first_order(tau):
    """Return the response of first-order lags [s]: one time constant for all, or one per part of a command."""
    return ActuatorResponse.of(tau.c, tau.omega) if isinstance(tau, Command) else ActuatorResponse.of(tau, tau)


def random_field_flight(field, key, *, n=100, delay_ticks=0):
    """Return a window of a flight with random commands; the plant is Eq. (1) plus ``field`` (x, u) [m/s^2].

    Commands act after ``delay_ticks`` ticks.
    """
    return _field_flight(field, key, n, delay_ticks)


@partial(jax.jit, static_argnums=(0, 2, 3))
def _field_flight(field, key, n, delay_ticks):
    model = PointMass(0.02)

    def command(k):
        kc, kw = random.split(k)
        return Command(9.81 + random.normal(kc, ()), 0.5 * random.normal(kw, (3,)))

    commands = jax.vmap(command)(random.split(key, n))
    hover = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (delay_ticks, *leaf.shape)), Command.hover(float))
    acting = jax.tree.map(lambda early, all_: jnp.concatenate([early, all_])[:n], hover, commands)
    _, states = lax.scan(lambda x, u: (model.step(x, u, field(x, u)), x), State.at(jnp.array(GOAL)), acting)
    return Window(0.02 * jnp.arange(float(n)), states, commands, jnp.ones(n, dtype=bool))


def tiny_preset(**changes):
    """Return the fast preset with a network and updates that are small enough for tests."""
    preset = changed(
        load("hover/fast"),
        pretrain={"hidden_sizes": (32, 32), "num_updates": 60, "num_envs": 8, "horizon": 60},
        adapt={"fit_steps": 20, "num_updates": 3, "num_envs": 4},
    )
    return changed(preset, **changes) if changes else preset


def brief_preset(name="hover/fast", **changes):
    """Return a preset for flights of a second or two with small updates; one size, so that programs are shared."""
    preset = changed(load(name), **BRIEF)
    return changed(preset, **changes) if changes else preset


_thousand = eqx.filter_jit(lambda reference, times: jax.vmap(reference)(times))


def at(reference, times):
    """Return the reference at many times, with one compiled program."""
    times = np.asarray(times, dtype=float)
    padding = np.append(times, np.zeros(-len(times) % 1000)).reshape(-1, 1000)
    result = [_thousand(reference, jnp.asarray(part)) for part in padding]
    return jax.tree.map(lambda *leaves: np.concatenate(leaves)[: len(times)], *result)


def check_slope(cost, inputs, key, *, h, rel):
    """Compare the gradient of a compiled function with differences in random directions, and return the gradient."""
    slope = jax.grad(cost)(inputs)
    leaves, shape = jax.tree.flatten(inputs)
    for k in random.split(key, 4):
        way = [random.normal(kk, leaf.shape) for kk, leaf in zip(random.split(k, len(leaves)), leaves, strict=True)]
        ahead, behind = (cost(shape.unflatten([a + s * d for a, d in zip(leaves, way, strict=True)])) for s in (h, -h))
        expected = sum(float(jnp.sum(a * b)) for a, b in zip(jax.tree.leaves(slope), way, strict=True))
        np.testing.assert_allclose((ahead - behind) / (2.0 * h), expected, rtol=rel, atol=1e-8)
    return slope


def stack_trees(trees):
    return jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves)), *trees)


def replace_fields(module, **fields):
    return dataclasses.replace(module, **fields)
