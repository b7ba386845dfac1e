"""Trains the baseline that needs training before a flight: DATT, which uses reinforcement learning."""

import time
from collections.abc import Sequence
from functools import partial
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax import random
from jaxtyping import Array, Key

from retrim.config.baselines import prediction_of
from retrim.config.presets import Preset
from retrim.config.setup import Setup
from retrim.errors import ConfigError
from retrim.runkit.codecs import tree_codec
from retrim.runkit.provenance import section_key
from retrim.runkit.reporter import Reporter
from retrim.runkit.run import Run
from retrim.runkit.store import Store

from .controller import SPACING, DattNet
from .ppo import PpoSettings, PpoState, ppo
from .problem import DattProblem, discount, reference_bank

DATT_STEPS = 20_000_000  # as in the paper
DATT_PPO: dict[str, Any] = {"envs": 64, "steps": 256, "minibatches": 8, "epochs": 6, "learning_rate": 2e-3}
DATT_TAG = 2**30 + 5  # folded into a seed, so that DATT does not share keys with the policies
STATE_EVERY = 30.0
"""Time between two stored states during training [s]."""


def check_steps(steps: int) -> None:
    """Check the number of training steps.

    Raises:
        ConfigError: The number is below one or above 10,000,000,000.
    """
    if not 1 <= steps <= 10**10:
        raise ConfigError(f"--datt-steps {steps} must be between 1 and 10,000,000,000")


def check_period(preset: Preset) -> None:
    """Check that the control period of a preset divides DATT's look-ahead step and is at most 20 ms.

    Raises:
        ConfigError: The period does not meet these conditions; the message names the preset.
    """
    apart = SPACING / preset.dt
    if abs(apart - round(apart)) > 1e-6 or preset.dt > 0.02:
        raise ConfigError(
            f"preset {preset.name!r}: DATT looks ahead in steps of {SPACING} s, which must be whole control periods of "
            f"20 ms or less, not of {1000 * preset.dt:g} ms"
        )


def round_steps(steps: int) -> int:
    """Return the number of training steps for a request of ``steps``, rounded up to whole updates."""
    settings = PpoSettings(**DATT_PPO)
    return settings.updates(steps) * settings.envs * settings.steps


def train_datt(
    preset: Preset, seeds: Sequence[int], run: Run, reporter: Reporter, *, steps: int = DATT_STEPS
) -> dict[int, DattNet]:
    """Return a network for each seed; networks that are already in ``run.trained`` are not trained again.

    Args:
        preset: Vehicle, control period and declared lag.
        seeds: Seeds for networks, references and episodes.
        run: Run whose ``trained`` folder stores the networks, and the state from which an interrupted training resumes.
            After an interruption, the incomplete seeds are missing from the result.
        reporter: Receives progress.
        steps: Number of training steps.
    """
    setup, nets = Setup.from_preset(preset), dict[int, DattNet]()
    store = Store(run.policy_folder, reporter=reporter, stop=run.stop)
    tau = float(prediction_of(setup).path.response.rate_lag[0])
    about = {"steps": str(steps), "dt": str(preset.dt), "tau": f"{tau:.4f}", "vehicle": str(preset.vehicle)}
    name = section_key(datt=about, precision=str(setup.vehicle.mass.dtype))
    for seed in seeds:
        if run.interrupted:
            break
        key = f"datt_{name}_seed{seed}"
        k_net, k_learn = random.split(random.fold_in(random.key(seed), DATT_TAG))
        net: DattNet = eqx.filter_jit(DattNet.of)(key=k_net)
        make = partial(_train, setup, net, k_learn, seed, steps, store, f"{key}_state", run, reporter)
        trained_policy = store.get_or_make(key, make, tree_codec(net, "datt", about))
        if trained_policy is None:
            break
        store.remove(f"{key}_state", tree_codec(net, "ppo"))
        nets[seed] = trained_policy
    return nets


def _train(
    setup: Setup,
    net: DattNet,
    k_learn: Key[Array, ""],
    seed: int,
    steps: int,
    store: Store,
    key: str,
    run: Run,
    reporter: Reporter,
) -> DattNet | None:
    """Train, and resume from the stored state of an earlier run if there is one.

    Return None if this run is interrupted; its state is then stored with ``key``.
    """
    low, high, dt = setup.vehicle.command_min, setup.vehicle.command_max, setup.preset.dt
    tau = prediction_of(setup).path.response.rate_lag[0]
    problem = DattProblem(jnp.asarray(reference_bank(seed, dt=dt), low.c.dtype), tau, low, high, dt)
    settings = PpoSettings(discount=discount(dt), **DATT_PPO)
    updates, title = settings.updates(steps), f"DATT, seed {seed}"
    state = PpoState.of(problem, net, k_learn, settings)
    codec = tree_codec(state, "ppo")
    if (stored := store.get(key, codec)) is not None:
        state = stored
        reporter.say(f"{title}: continues after{int(state.made)} of {updates} updates")
    with run.interruptible(), reporter.progress(f"{title}, {steps:,} steps") as advance:
        last_write = time.monotonic()
        for after, figures in ppo(problem, state, settings, steps=steps):
            state = after
            advance(int(state.made) / updates, f"reward {figures['reward']:.3f}")
            if run.interrupted:
                break
            if time.monotonic() - last_write > STATE_EVERY:
                store.put(key, state, codec)
                last_write = time.monotonic()
    if run.interrupted:
        store.put(key, state, codec)
        return None
    trained_policy: DattNet = state.net
    return trained_policy


RIVALS = {"datt": train_datt}
"""Training functions by method; for a preset and seeds, each returns networks that replace the policies."""
