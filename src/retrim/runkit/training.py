"""Pretrains policies with progress reports, and measures a policy's error in its own model."""

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, wait
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import random
from jaxtyping import Array, Key

from ..config.loading import changed, dump, parse
from ..config.presets import Preset
from ..config.setup import Setup
from ..control.policy import AbstractPolicy
from ..errors import JobError
from ..learn.env import Env
from ..learn.residuals.model import FittedResidual
from ..learn.rollout import rollout
from .reporter import Reporter, Silent


class TrainingResult(NamedTuple):
    """Result of pretraining; after an interruption, the last state of training."""

    policy: AbstractPolicy
    losses: list[float]
    """Loss at each optimiser step."""


def train(
    setup: Setup, seed: int = 0, *, reporter: Reporter | None = None, stop: threading.Event | None = None
) -> TrainingResult:
    """Pretrain a policy.

    Args:
        setup: Set-up of the preset to train with.
        seed: Seed for the weights and starts.
        reporter: Receives the progress.
        stop: Ends training after the current steps when it is set. Ctrl-C sets it, too.
    """
    stop = stop or threading.Event()
    p, vision = setup.preset.pretrain, setup.preset.vision
    policy, losses = setup.new_policy(random.key(seed)), list[float]()
    first = f"encoder, {vision.encoder_steps} steps" if vision and vision.encoder_steps else "compiling"
    title = f"pretraining, {p.num_updates} x {p.num_envs} x {p.horizon}"
    with (reporter or Silent()).progress(title) as advance:
        advance(0.0, first)
        try:
            for after, latest in setup.pretraining(seed):
                policy = after
                losses += [float(loss) for loss in latest]
                advance(len(losses) / p.num_updates, f"loss {losses[-1]:.3f}")
                if stop.is_set():
                    break
        except KeyboardInterrupt:
            stop.set()
    return TrainingResult(policy, losses)


def train_elsewhere(
    preset: Preset,
    seeds: Sequence[int],
    executor: Executor,
    *,
    reporter: Reporter,
    stop: threading.Event,
    on_result: Callable[[int, AbstractPolicy], None] = lambda seed, policy: None,
) -> dict[int, AbstractPolicy]:
    """Pretrain a policy for each seed, all at once, in other processes.

    Args:
        preset: Preset to train with.
        seeds: Seeds for the weights and starts.
        executor: Executor with other processes, which trains one seed per job.
        reporter: Receives the progress.
        stop: Aborts the unfinished jobs when it is set. Ctrl-C sets it, too.
        on_result: Receives each policy when it is trained.

    Returns:
        Policies by seed; all of them, unless ``stop`` was set.

    Raises:
        JobError: A job failed; raised after the others are completed.
    """
    jobs = {executor.submit(train_job, dump(preset), seed): seed for seed in seeds}
    result, failures, waiting = dict[int, AbstractPolicy](), list[str](), set(jobs)
    try:
        with reporter.progress(f"pretraining {preset.name} elsewhere") as advance:
            while waiting and not stop.is_set():
                advance(len(result) / len(jobs), f"{len(result)} of {len(jobs)} seeds")
                for job in wait(waiting, 1.0, FIRST_COMPLETED).done:
                    waiting.remove(job)
                    if (error := job.exception()) is not None:
                        failures.append(f"seed {jobs[job]}: {' '.join(str(error).split())}")
                        continue
                    result[jobs[job]] = job.result()
                    on_result(jobs[job], result[jobs[job]])
            advance(len(result) / len(jobs), f"{len(result)} of {len(jobs)} seeds")
    except KeyboardInterrupt:
        stop.set()
    finally:
        for job in waiting:
            job.cancel()
    if failures:
        raise JobError(f"{len(failures)} of {len(jobs)} trainings of {preset.name} failed: {failures[0]}")
    return {seed: result[seed] for seed in seeds if seed in result}


def train_job(preset: str, seed: int) -> AbstractPolicy:
    """Pretrain a policy with a preset (JSON), in another process."""
    return train(Setup.from_preset(parse(preset, source="preset")), seed).policy


def ground_warning(setup: Setup) -> str | None:
    """Return a line if the goal or the reference of the flight is below the ground; None if it is not."""
    home, reference = setup.flight_task.home(), setup.flight_reference
    lowest = float(home[2]) if reference is None else float(reference.rows[:, 2].min())
    if lowest >= 0.0:
        return None
    return f"the goal or the reference is at z = {lowest:g} m, below the ground; z points up, so negate z of NED data"


def nominal_error(setup: Setup, policy: AbstractPolicy, *, n: int = 64, seed: int = 1) -> float:
    """Return the mean error in the policy's own model [m], over the last half second of 6 s.

    Args:
        setup: Set-up of the policy's preset.
        policy: The policy.
        n: Number of roll-outs; their starts are drawn as in training.
        seed: Seed for the starts.
    """
    return _mean_error(setup, _long(setup).env, policy, n, seed)


def model_error(setup: Setup, policy: AbstractPolicy, residual: FittedResidual, *, n: int = 64, seed: int = 1) -> float:
    """Return the error of :func:`nominal_error` in a model with a residual, with the policy's in-flight observation."""
    learner = _long(setup).learner
    return _mean_error(setup, learner.view(learner.env, residual), policy, n, seed)


def _long(setup: Setup) -> Setup:
    """Return the set-up with roll-outs of 6 s."""
    return Setup.from_preset(changed(setup.preset, pretrain={"horizon": round(6.0 / setup.preset.dt)}))


def _mean_error(setup: Setup, env: Env, policy: AbstractPolicy, n: int, seed: int) -> float:
    return float(_end_errors(policy, env, random.key(seed), n, round(0.5 / setup.preset.dt)))


@eqx.filter_jit
def _end_errors(policy: AbstractPolicy, env: Env, key: Key[Array, ""], n: int, ticks: int) -> Array:
    def error(k: Key[Array, ""]) -> Array:
        start = env.task.reset(k)
        trajectory = rollout(env, policy, start)
        last = jax.tree.map(lambda leaf: leaf[-ticks:], trajectory.x)
        horizon = env.task.horizon
        times = start.t + env.task.dt * jnp.arange(horizon - ticks, horizon, dtype=start.t.dtype)
        return jnp.mean(jax.vmap(env.task.error)(times, last))

    return jnp.mean(jax.vmap(error)(random.split(key, n)))
