"""The paper's design study (Sec. IV-C): which model is simulated, and which model the gradient flows through."""

import functools
import math
import time
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
import optax
from jax import random
from jaxtyping import Array, Key

from retrim.config.scenario import Scenario
from retrim.config.setup import Setup
from retrim.control.controller import PolicyController
from retrim.control.policy import AbstractPolicy
from retrim.learn.bptt import PolicyState
from retrim.learn.env import Env
from retrim.learn.pretrain import train_chunk
from retrim.learn.residuals.ensemble import EnsembleResidual, EnsembleState, fit_ensemble
from retrim.learn.residuals.targets import Targets, residual_targets
from retrim.learn.stacking import stack
from retrim.learn.window import Window
from retrim.physics.dynamics import AbstractDynamics, Hybrid, PointMass, StraightThrough
from retrim.physics.rotors import LinearDragQuadrotor
from retrim.plants.sim import SimPlant
from retrim.runtime.flight import Log
from retrim.runtime.pilot import ControllerPilot
from retrim.runtime.together import fly_together

PUSH, PLANT = "push-x=2", "bem"  # the paper's push: 2 m/s^2 along +x
ROLLOUTS, ROLLOUT_S = 50, 3.0
FIT_EPOCHS, POLICY_EPOCHS, ENVS = 200, 100, 100
CHUNK = 10  # epochs per program
SCORE_S = 10.0  # [s]


class Choice(NamedTuple):
    """A way to simulate and differentiate."""

    rotors: bool
    """Whether the model has rotors, a thrust map, drag and a rate controller at 1 kHz; otherwise it is a point mass."""
    own_gradient: bool
    """Whether the gradient comes from the simulated model; otherwise it comes from the point mass."""
    backprop: bool
    """Whether gradients flow through the residual, too."""


CHOICES = {
    "low fidelity, res-fwd": Choice(False, True, False),
    "low fidelity, res-fwd + res-back": Choice(False, True, True),
    "high fidelity, its own gradient, res-fwd": Choice(True, True, False),
    "high fidelity, its own gradient, res-fwd + res-back": Choice(True, True, True),
    "high fidelity, the gradient of low fidelity, res-fwd": Choice(True, False, False),
    "high fidelity, the gradient of low fidelity, res-fwd + res-back": Choice(True, False, True),
}


class Retraining(NamedTuple):
    """Training result for one choice."""

    policy: AbstractPolicy
    compile_s: float
    epoch_s: list[float]
    """Mean epoch time in each executed program [s]."""
    residual_rms: float
    """Root mean square error of the residual fit [m/s^2]."""


def fly_batch_of_policy(setup: Setup, policy: AbstractPolicy, n: int, seconds: float, seed: int) -> list[Log]:
    """Fly a policy from random starts without learning, on the study's plant, as one batch."""
    plants = [Scenario(PUSH, PLANT).make(setup.preset.vehicle, dt=setup.preset.dt) for _ in range(n)]
    controller = PolicyController(setup.flight_task.observation_in_flight, policy)
    return fly_together(
        [plant for plant in plants if isinstance(plant, SimPlant)],
        [ControllerPilot(controller) for _ in plants],
        setup.flight_starts(n, seed),
        ticks=round(seconds / setup.preset.dt),
    )


def design_dynamics(setup: Setup, residual: Any, choice: Choice) -> AbstractDynamics[Any]:
    """Return the model for a choice, used for simulation and for the gradient.

    Args:
        setup: Vehicle and control period.
        residual: Residual fitted to the simulated model.
        choice: Way to simulate and differentiate.
    """
    simple = PointMass(setup.preset.dt)
    forward = Hybrid(_nominal(setup, choice), residual, backprop=choice.backprop)
    if choice.own_gradient:
        return forward
    return StraightThrough(forward, Hybrid(simple, residual, backprop=True) if choice.backprop else simple)


def retrain(setup: Setup, policy: AbstractPolicy, logs: Sequence[Log], key: Key[Array, ""], choice: Choice, *,
              fit_epochs: int = FIT_EPOCHS, epochs: int = POLICY_EPOCHS, envs: int = ENVS) -> Retraining:  # fmt: skip
    """Fit one residual network to flights and re-train the policy with it.

    Args:
        setup: Set-up of the policy.
        policy: Policy from which training starts.
        logs: Logs of the flights.
        key: Random key; consumed.
        choice: Way to simulate and differentiate.
        fit_epochs: Training epochs for the residual network.
        epochs: Training epochs for the policy; a multiple of ten.
        envs: Roll-outs per epoch.
    """
    k_fit, k_train = random.split(key)
    nominal = _nominal(setup, choice)
    windows = stack([log.window(len(log.t) - 1) for log in logs])
    rows = _rows(windows, nominal, setup.preset.plant_delay_ticks)
    adapt = setup.preset.adapt
    adam = _adam(adapt.fit_learning_rate)
    residual = EnsembleResidual.of(setup.flight_task.home(), setup.vehicle.omega_max, key=k_fit, members=1)
    new_residual, errors = _fit(EnsembleState.of(residual, adam), rows, adam, fit_epochs)
    dynamics = design_dynamics(setup, new_residual.residual, choice)
    env = Env(dynamics, setup.env.task, setup.env.delay, longest_delay=setup.env.longest_delay)
    optimiser = _of_policy(adapt.learning_rate, adapt.max_grad_norm or math.inf, epochs)
    state = PolicyState(policy, optimiser.init(policy.params))
    times = list[float]()
    for k in random.split(k_train, 1 + epochs // CHUNK):  # the first run compiles; its result is discarded
        began = time.perf_counter()
        after, _ = jax.block_until_ready(train_chunk(state, env, k, optimiser, CHUNK, envs))
        times.append(time.perf_counter() - began)
        state = after if len(times) > 1 else state
    run = float(np.median(times[1:]))
    return Retraining(state.policy.merged(), times[0] - run, [t / CHUNK for t in times[1:]], float(errors[-1]) ** 0.5)


def _nominal(setup: Setup, choice: Choice) -> AbstractDynamics[Any]:
    dt = setup.preset.dt
    return LinearDragQuadrotor.of(setup.vehicle, dt, thrust_error=0.0) if choice.rotors else PointMass(dt)


@functools.cache
def _adam(learning_rate: float) -> optax.GradientTransformation:
    """Return Adam; the same rate gives the same object, so programs that use it are compiled once."""
    return optax.adam(learning_rate)


@functools.cache
def _of_policy(learning_rate: float, max_grad_norm: float, epochs: int) -> optax.GradientTransformation:
    """Return the policy optimiser, cached so that its programs are compiled once.

    It applies the preset's gradient clipping, then Adam with a rate that falls to zero, as updates in flight do.
    """
    rate = optax.cosine_decay_schedule(learning_rate, epochs)
    return optax.chain(optax.clip_by_global_norm(max_grad_norm), optax.adam(rate))


@eqx.filter_jit
def _rows(windows: Window, nominal: AbstractDynamics[Any], delay_ticks: int) -> Targets:
    """Return the concatenated targets of many windows (leading axis)."""
    many = jax.vmap(lambda window: residual_targets(window, nominal, delay_ticks=delay_ticks))(windows)
    return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), many)  # type: ignore[no-any-return]


@eqx.filter_jit
def _fit(
    state: EnsembleState, rows: Targets, optimiser: optax.GradientTransformation, steps: int
) -> tuple[EnsembleState, Array]:
    return fit_ensemble(state, rows, optimiser=optimiser, steps=steps, spectral_weight=1e-3)
