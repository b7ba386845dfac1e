"""What ``retrim bench`` times of pretraining."""

from typing import Any

from jax import random

from .. import build, presets
from ..learn.bptt import PolicyState
from ..learn.pretrain import train_chunk
from ..presets import Preset
from .bench_timing import compiled, timed
from .session import Stopwatch
from .training import nominal_error, train


def pretrain(preset: Preset, runs: int) -> dict[str, Any]:
    """Pretraining without seeing, each run with a seed of its own; and the errors of their policies."""
    p, key = preset.pretrain, random.key(0)
    optimiser = build.optimiser(preset)
    policy = build.policy(preset, key)
    state = PolicyState(policy, optimiser.init(policy.layers))
    fixed = build.nominal(preset), build.task(preset)
    sizes = optimiser, 10, p.envs, preset.delay
    program, compile_s = compiled(train_chunk, state, *fixed, key, *sizes)

    kept = list[PolicyState]()

    def run() -> PolicyState:
        trained = state
        for k in random.split(random.key(len(kept) + 1), p.epochs // 10):
            trained, _ = program(trained, *fixed, k, *sizes)
        kept.append(trained)
        return trained

    row = timed(compile_s, run, runs)
    errors = [nominal_error(preset, trained.policy.plain()) for trained in kept]
    row["remarks"] += "; error " + ", ".join(f"{1000 * e:.1f}" for e in errors) + " mm"
    return row


def see_and_pretrain(name: str) -> dict[str, Any]:
    """Representation, then policy, of a preset for vision."""
    preset, watch = presets.load(name), Stopwatch()
    policy, _, _ = train(preset, 0)
    row = {"compile_s": watch.compile_s, "run_s": watch.total_s - watch.compile_s}
    return row | {"remarks": f"error {1000 * nominal_error(preset, policy):.1f} mm"}
