"""Baselines that are trained before they fly: DATT, by reinforcement learning."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax import random

from ..config.baselines import prediction_of
from ..config.presets import Preset
from ..config.setup import Setup
from ..control.datt import APART, DattNet
from ..errors import ConfigError, MessageError
from ..io.files import write_whole
from ..learn.datt import DattProblem, discount, reference_bank
from ..learn.ppo import PpoSettings, ppo
from ..transport import wire
from .provenance import section_key
from .reporter import Reporter
from .run import Run

DATT_STEPS = 20_000_000  # the paper's
DATT_PPO: dict[str, Any] = {"envs": 64, "steps": 256, "minibatches": 8, "epochs": 6, "learning_rate": 2e-3}
DATT_TAG = 2**30 + 5  # folded into a seed: DATT shares no key with the policies


def check_steps(steps: int) -> None:
    """Refuse a number of training steps that is none.

    Raises:
        ConfigError: It is below one, or beyond what a computer does in a day.
    """
    if not 1 <= steps <= 10**10:
        raise ConfigError(f"--datt-steps {steps} must be between 1 and 10,000,000,000")


def check_rival(preset: Preset) -> None:
    """Refuse a control period that does not fit the look-ahead.

    Raises:
        ConfigError: It names the preset.
    """
    apart = APART / preset.dt
    if abs(apart - round(apart)) > 1e-6 or preset.dt > 0.02:
        raise ConfigError(
            f"preset {preset.name!r}: DATT looks ahead in steps of {APART} s, which must be whole control periods of "
            f"20 ms or less, not of {1000 * preset.dt:g} ms"
        )


def steps_made(steps: int) -> int:
    """Return the steps that are made where ``steps`` are asked for: whole updates."""
    settings = PpoSettings(**DATT_PPO)
    return settings.updates(steps) * settings.envs * settings.steps


def trained_datt(
    preset: Preset, seeds: Sequence[int], run: Run, reporter: Reporter, *, steps: int = DATT_STEPS
) -> dict[int, DattNet]:
    """Return a network for each seed; those that ``run.trained`` has are not trained again.

    Args:
        preset: Vehicle, control period and declared lag.
        seeds: Seeds of networks, references and episodes.
        run: Its ``trained`` keeps the networks; an interruption leaves out the seeds that are not complete.
        reporter: Receives progress.
        steps: Steps of training.
    """
    setup, nets = Setup.of(preset), dict[int, DattNet]()
    tau = prediction_of(setup).tau
    about = {"steps": str(steps), "dt": str(preset.dt), "tau": f"{float(tau):.4f}", "vehicle": str(preset.vehicle)}
    name = section_key(datt=about, precision=str(setup.vehicle.mass.dtype))
    for seed in seeds:
        if run.interrupted:
            break
        path = run.trained / f"datt_{name}_seed{seed}.safetensors"
        key = random.fold_in(random.key(seed), DATT_TAG)
        k_net, k_learn = random.split(key)
        net: DattNet = eqx.filter_jit(DattNet.of)(key=k_net)
        arrays, fixed = eqx.partition(net, eqx.is_array)
        if path.is_file():
            try:
                nets[seed] = eqx.combine(wire.unpack(path.read_bytes(), arrays, kind="datt", source=str(path)), fixed)
                continue
            except MessageError as error:
                reporter.say(f"{error}; trained again")
        low, high = setup.vehicle.command_min, setup.vehicle.command_max
        problem = DattProblem(jnp.asarray(reference_bank(seed, dt=preset.dt), low.c.dtype), tau, low, high, preset.dt)
        settings = PpoSettings(discount=discount(preset.dt), **DATT_PPO)
        with run.interruptible(), reporter.progress(f"DATT, seed {seed}, {steps:,} steps") as advance:
            for i, (after, told) in enumerate(ppo(problem, net, k_learn, settings, steps=steps)):
                advance((i + 1) / settings.updates(steps), f"reward {told['reward']:.3f}")
                net = after
                if run.interrupted:
                    break
        if run.interrupted:
            break
        write_whole(path, wire.pack(eqx.filter(net, eqx.is_array), kind="datt", about=about))
        nets[seed] = net
    return nets


RIVALS = {"datt": trained_datt}
"""By method: from a preset and seeds to what is flown in place of the policies."""
