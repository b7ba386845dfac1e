"""From a preset's numbers to objects: task, models, learners, starts."""

import dataclasses
import functools
import math
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import random
from jaxtyping import Array, Float, Key

from .adapt.adapter import Adapter
from .adapt.lockstep import AdaptivePilot, Schedule
from .control.lora import LoraPolicy
from .control.policy import Policy
from .learn.pretrain import pretrain
from .learn.represent import represent
from .learn.residual import EnsembleResidual
from .physics.dynamics import AbstractDynamics, PointMass
from .physics.lag import Lagged
from .physics.state import State
from .physics.vehicle import Vehicle
from .presets import DT, Preset, PresetError
from .tasks.hover import TILT, Hover, SharpHover
from .tasks.keypoints import Keypoints
from .tasks.observation import AbstractObservation, StateObs
from .tasks.preview import Preview
from .tasks.reference import REFERENCES, Reference, from_csv, joined
from .tasks.task import AbstractTask
from .tasks.track import AbstractTrack, SharpTrack, Track
from .testbed import VEHICLES

STARTS = 1  # folded into a seed for the starts of flights, so that they share no key with training


def vehicle(preset: Preset) -> Vehicle:
    """The vehicle."""
    return VEHICLES[preset.vehicle]()


def task(preset: Preset, flown: Reference | None = None) -> AbstractTask:
    """The task, with the observation that training and flight share; ``flown`` is tracked instead of the preset's."""
    goal = jnp.array(preset.goal)
    observation = StateObs(goal, vehicle(preset).omega_max, preset.history)
    if preset.task == "track":
        return _track(preset, observation, flown or reference(preset.reference))
    seen = keypoints(preset) if preset.task == "vision" else observation
    reward = SharpHover if preset.reward == "sharp" else Hover
    return reward(goal, seen, jnp.array(preset.box), jnp.array(preset.pretrain.heading), DT, preset.pretrain.horizon)


@functools.cache
def keypoints(preset: Preset) -> Keypoints:
    """What a vision policy sees in training, where every point is fed; its whitening is computed once."""
    with jax.ensure_compile_time_eval():
        return Keypoints.of(
            jnp.array(preset.goal),
            vehicle(preset).omega_max,
            honest=False,
            noise=preset.pixel_noise,
            whitened=preset.whitened,
        )


def seen_in_flight(preset: Preset, flown: Reference | None = None) -> AbstractObservation[Any]:
    """What the policy sees in flight: what it saw in training, unless visibility is honest.

    Points that a camera does not see are completed by a pose filter so well that training need not know of it.
    """
    if preset.task == "vision" and preset.honest:
        return dataclasses.replace(keypoints(preset), honest=True, dropout=jnp.array(preset.dropout))
    return task(preset, flown).observation


def _track(preset: Preset, state: StateObs, followed: Reference) -> AbstractTask:
    preview = Preview(followed, state.omega_max, preset.history)
    seen: AbstractObservation[Any] = preview if preset.observation == "preview" else state
    reward = SharpTrack if preset.reward == "sharp" else Track
    return reward(followed, seen, jnp.array(preset.spread), jnp.array(preset.box), DT, preset.pretrain.horizon)


@functools.cache
def reference(names: str) -> Reference:
    """A reference by name or CSV file; several, joined by +, become a family. Raises :class:`PresetError`."""
    with jax.ensure_compile_time_eval():  # may be called while something is traced; the tables are kept
        found = [_reference(name) for name in names.split("+")]
        return found[0] if len(found) == 1 else joined(found)


def _reference(name: str) -> Reference:
    if name in REFERENCES:
        return REFERENCES[name]()
    if not name.endswith(".csv"):
        raise PresetError(f"no reference {name!r}; there are {', '.join(REFERENCES)}, and CSV files of t, x, y, z")
    try:
        return from_csv(Path(name))
    except (OSError, UnicodeDecodeError, ValueError) as error:
        raise PresetError(str(error)) from error


def nominal(preset: Preset) -> AbstractDynamics[Any]:
    """The analytical model."""
    return PointMass(DT) if preset.lag is None else Lagged(PointMass(DT), jnp.array(preset.lag))


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


def pretraining(preset: Preset, seed: int = 0) -> Iterator[tuple[Policy, Float[Array, " epochs"]]]:
    """Train a policy from scratch: after every few epochs the policy so far, and the losses of those epochs.

    Where the preset has it, the policy first learns to see; the first value comes after that.
    """
    k_init, k_train = random.split(random.key(seed))
    fresh, p = policy(preset, k_init), preset.pretrain
    if preset.task == "vision" and preset.represent:
        fresh, _ = represent(fresh, keypoints(preset), random.split(k_init)[1], steps=preset.represent)
    epochs = pretrain(
        fresh,
        nominal(preset),
        task(preset),
        k_train,
        optimiser=optimiser(preset),
        epochs=p.epochs,
        envs=p.envs,
        delay=preset.delay,
        chunk=math.gcd(p.epochs, 10),
    )
    return ((state.policy.plain(), losses) for state, losses in epochs)


def pretrained(preset: Preset, seed: int = 0) -> Policy:
    """A policy trained from scratch, in silence; :func:`pretraining` shows progress."""
    ((last, _),) = deque(pretraining(preset, seed), maxlen=1)
    return last


def adapter(preset: Preset, flown: Reference | None = None) -> Adapter:
    """The learner beside the flight; it re-trains on what is ``flown``, or on what the policy was trained on."""
    a = preset.adapt
    return Adapter(
        task(preset, flown),
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


@jax.jit
def lora(policy: Policy, key: Key[Array, ""]) -> LoraPolicy:
    """A fresh low-rank delta on ``policy``, ranks 4, 10, 1 and scale 4 as in the paper; the key is consumed."""
    return LoraPolicy.of(policy, key=key)


def schedule(preset: Preset, *, measured: bool = False) -> Schedule:
    """When to learn; ``measured`` charges the time that the clock shows instead of the preset's fixed figures."""
    a = preset.adapt
    return Schedule(
        a.refine_every,
        a.improve_every,
        None if measured else a.refine_charge,
        None if measured else a.improve_charge,
    )


def pilot(
    preset: Preset,
    policy: Policy | LoraPolicy,
    key: Key[Array, ""],
    flown: Reference | None = None,
    *,
    measured: bool = False,
) -> AdaptivePilot:
    """Flies ``policy`` and re-trains it as it flies; the key is consumed. ``measured`` as in :func:`schedule`."""
    k_residual, k_learn = random.split(key)
    learner = adapter(preset, flown)
    return AdaptivePilot(
        learner,
        learner.init(policy, residual(preset, k_residual)),
        schedule(preset, measured=measured),
        k_learn,
        dt=DT,
        window=preset.adapt.window,
        observation=seen_in_flight(preset, flown),
    )


def flight_starts(preset: Preset, n: int, seed: int = 0, flown: Reference | None = None) -> list[State]:
    """``n`` starts, the same for every preset: +- 1 m per axis, 18 degrees about each axis, 0.1 m/s.

    Around the goal, or around where the reference starts.
    """
    task_flown = task(preset, flown)
    here = task_flown.reference(jnp.array(0.0)).p if isinstance(task_flown, AbstractTrack) else jnp.array(preset.goal)
    nearby = Hover(here, task_flown.observation, jnp.array(preset.box), jnp.array(TILT))
    batch = jax.jit(lambda key: jax.vmap(nearby.reset)(random.split(key, n)).x)(
        random.fold_in(random.key(seed), STARTS)
    )
    return [jax.tree.map(lambda leaf, i=i: jnp.asarray(np.asarray(leaf)[i]), batch) for i in range(n)]
