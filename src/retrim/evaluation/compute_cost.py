"""Measures the cost of each method: steps and time for training, for an update in flight, and for one decision."""

import time
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import random

from ..adapt.buffer import RollingBuffer
from ..adapt.learner import OnlineLearner
from ..config.scenario import Scenario
from ..config.setup import Setup
from ..control.controller import AbstractController
from ..learn.window import Window
from ..physics.state import Command
from ..runkit.stopwatch import Stopwatch

TIMED_RUNS = 9  # runs of each timed program
DECISIONS = 200


def time_runs(work: Callable[[], Any], runs: int) -> tuple[float, float]:
    """Return the compile time and the median run time [s]."""
    watch = Stopwatch()
    jax.block_until_ready(work())
    times, program = list[float](), watch.compile_s
    for _ in range(runs):
        began = time.perf_counter()
        jax.block_until_ready(work())
        times.append(time.perf_counter() - began)
    return program, float(np.median(times))


def updates(setup: Setup, *, lora: bool = False) -> dict[str, Any]:
    """Measure the time that a residual fit and a policy update take, both as in flight.

    Args:
        setup: Set-up with the adaptation preset.
        lora: Whether to update a low-rank delta.
    """
    policy: Any = setup.new_policy(random.key(0))
    if lora:
        policy = setup.low_rank(policy, random.key(2))
    learner, window = setup.learner, full_window(setup)
    state = learner.init(policy, random.key(1))
    fit_compile, fit_s = time_runs(lambda: OnlineLearner.fit_residual(learner, state.residual, window), TIMED_RUNS)
    residual, _ = learner.fit_residual(state.residual, window)
    key = random.key(0)
    compile_s, run_s = time_runs(
        lambda: OnlineLearner.update_policy(learner, state.policy, residual, window, key), TIMED_RUNS
    )
    a = setup.preset.adapt
    return {
        "fit_s": fit_s,
        "update_s": run_s,
        "compile_s": fit_compile + compile_s,
        "update_steps": a.num_updates * a.num_envs * setup.flight_task.horizon,
        "window_s": a.window * setup.preset.dt,
    }


def decision_s(setup: Setup, controller: AbstractController[Any]) -> float:
    """Return the median time for one decision [s]."""
    x = setup.flight_starts(1)[0]
    decide = eqx.filter_jit(lambda controller, memory, t, x: controller(memory, t, x))
    memory, t = controller.init(x), jnp.zeros_like(x.p[0])
    _, memory = jax.block_until_ready(decide(controller, memory, t, x))
    return time_runs(lambda: decide(controller, memory, t, x), DECISIONS)[1]


def full_window(setup: Setup) -> Window:
    """Return a full window of flight under the large disturbance, with hover commands."""
    plant = Scenario("large").make(setup.preset.vehicle, dt=setup.preset.dt)
    buffer = RollingBuffer(setup.preset.adapt.window)
    measurement = plant.reset(setup.flight_starts(1)[0])
    for _ in range(setup.preset.adapt.window):
        buffer.push(measurement.t, measurement.x, Command.hover())
        measurement, _ = plant.step(Command.hover())
    return buffer.window()
