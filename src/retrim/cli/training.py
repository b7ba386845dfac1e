"""Pretraining with a progress bar."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import random
from jaxtyping import Array
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from .. import build, presets
from ..control.policy import Policy
from ..learn.rollout import rollout
from ..physics.dynamics import AbstractDynamics
from ..presets import Preset
from ..tasks.task import AbstractTask, Start
from .session import console


def train(preset: Preset, seed: int) -> tuple[Policy, list[float], bool]:
    """A pretrained policy, each epoch's loss, and whether Ctrl-C cut it short (then it is the last state reached)."""
    policy, losses, interrupted = build.policy(preset, random.key(seed)), list[float](), False
    p = preset.pretrain
    first = f"learning to see, {preset.represent} steps ..." if preset.represent else "compiling ..."
    columns = TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[loss]}"), TimeRemainingColumn()
    with Progress(*columns, console=console) as progress:
        bar = progress.add_task(f"pretraining, {p.epochs} x {p.envs} x {p.horizon}", total=p.epochs, loss=first)
        try:
            for trained, latest in build.pretraining(preset, seed):
                policy = trained
                losses += [float(loss) for loss in latest]
                progress.update(bar, completed=len(losses), loss=f"loss {losses[-1]:.3f}")
        except KeyboardInterrupt:
            interrupted = True
    return policy, losses, interrupted


def nominal_error(preset: Preset, policy: Policy, *, n: int = 64, seed: int = 1) -> float:
    """Mean error in the policy's own model over the last half second of 6 s, from ``n`` starts of its training [m]."""
    long = build.task(presets.changed(preset, pretrain={"horizon": round(6.0 / presets.DT)}))
    x0 = jax.vmap(long.reset)(random.split(random.key(seed), n))
    return float(_settled(policy, build.nominal(preset), long, x0, preset.delay))


@eqx.filter_jit
def _settled(policy: Policy, dynamics: AbstractDynamics[Any], task: AbstractTask, x0: Start, delay: int) -> Array:
    def error(start: Start) -> Array:
        flown = rollout(dynamics, task, policy, start, delay=delay)
        last = jax.tree.map(lambda leaf: leaf[-25:], flown.x)
        times = start.t + task.dt * jnp.arange(task.horizon - 25, task.horizon, dtype=start.t.dtype)
        return jnp.mean(jax.vmap(task.error)(times, last))

    return jnp.mean(jax.vmap(error)(x0))
