"""From a preset's numbers to objects: task, models, learners, starts."""

import dataclasses
import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import random
from jaxtyping import Array, Key

from .adapt.adapter import Adapter
from .adapt.lockstep import Schedule
from .control.policy import Policy
from .learn.residual import EnsembleResidual
from .physics.dynamics import PointMass
from .physics.state import State
from .physics.vehicle import Vehicle
from .presets import DT, Preset
from .tasks.hover import TILT, Hover
from .tasks.observation import StateObs
from .testbed import VEHICLES

STARTS = 1  # folded into a seed for the starts of flights, so that they share no key with training


def vehicle(preset: Preset) -> Vehicle:
    """The vehicle."""
    return VEHICLES[preset.vehicle]()


def task(preset: Preset) -> Hover:
    """The task, with the observation that training and flight share."""
    goal = jnp.array(preset.goal)
    observation = StateObs(goal, vehicle(preset).omega_max, preset.history)
    return Hover(
        goal, observation, jnp.array(preset.box), jnp.array(preset.pretrain.heading), DT, preset.pretrain.horizon
    )


def nominal(preset: Preset) -> PointMass:
    """The analytical model."""
    return PointMass(DT)


@functools.partial(jax.jit, static_argnums=0)
def policy(preset: Preset, key: Key[Array, ""]) -> Policy:
    """An untrained policy; the key is consumed."""
    return Policy.of(task(preset).observation.size, vehicle(preset), key=key, hidden=preset.pretrain.hidden)


@functools.cache
def optimiser(preset: Preset) -> optax.GradientTransformation:
    """For pretraining: Adam under a cosine, behind a clip. The same object for the same preset, so nothing retraces."""
    p = preset.pretrain
    schedule = optax.cosine_decay_schedule(p.rate, p.epochs)
    return optax.chain(optax.clip_by_global_norm(p.clip or math.inf), optax.adam(schedule, b2=p.b2))


def adapter(preset: Preset) -> Adapter:
    """The learner beside the flight."""
    a = preset.adapt
    return Adapter(
        task(preset),
        nominal(preset),
        residual_rate=jnp.array(a.residual_rate),
        beta=jnp.array(a.beta),
        policy_rate=jnp.array(a.rate),
        clip=jnp.array(a.clip or math.inf),
        delay=preset.delay,
        plant_delay=preset.plant_delay,
        iters=a.iters,
        epochs=a.epochs,
        envs=a.envs,
    )


@functools.partial(jax.jit, static_argnums=0)
def residual(preset: Preset, key: Key[Array, ""]) -> EnsembleResidual:
    """An ensemble that predicts zero; the key is consumed."""
    return EnsembleResidual.of(jnp.array(preset.goal), vehicle(preset).omega_max, key=key)


def schedule(preset: Preset, *, measured: bool = False) -> Schedule:
    """When to learn; ``measured`` charges the time that the clock shows instead of the preset's fixed figures."""
    a = preset.adapt
    return Schedule(
        a.refine_every,
        a.improve_every,
        None if measured else a.refine_charge,
        None if measured else a.improve_charge,
    )


def flight_starts(preset: Preset, n: int, seed: int = 0) -> list[State]:
    """``n`` starts, the same for every preset: goal +- 1 m per axis, 18 degrees about each axis, 0.1 m/s."""
    here = dataclasses.replace(preset, pretrain=dataclasses.replace(preset.pretrain, heading=TILT))
    batch = jax.jit(lambda key: jax.vmap(task(here).reset)(random.split(key, n)))(
        random.fold_in(random.key(seed), STARTS)
    )
    return [jax.tree.map(lambda leaf, i=i: jnp.asarray(np.asarray(leaf)[i]), batch) for i in range(n)]
