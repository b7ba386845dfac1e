"""Pretraining benchmarks."""

from typing import Any

from jax import random

from ..config.loading import load
from ..config.setup import Setup
from ..learn.bptt import PolicyState
from ..learn.pretrain import train_chunk
from ..runkit.stopwatch import Stopwatch
from ..runkit.training import nominal_error, train
from .timing import compile_function, time_runs


def pretrain(name: str, runs: int) -> dict[str, Any]:
    """Time pretraining without an encoder, with a new seed for each run; the row includes the policies' errors."""
    setup = Setup.from_preset(load(name))
    p, optimiser = setup.preset.pretrain, setup.optimiser
    policy = setup.new_policy(random.key(0))
    state = PolicyState(policy, optimiser.init(policy.params))
    sizes = optimiser, 10, p.num_envs
    program, compile_s = compile_function(train_chunk, state, setup.env, random.key(0), *sizes)

    states = list[PolicyState]()

    def run() -> PolicyState:
        state_now = state
        for k in random.split(random.key(len(states) + 1), p.num_updates // 10):
            state_now, _ = program(state_now, setup.env, k, *sizes)
        states.append(state_now)
        return state_now

    row = time_runs(compile_s, run, runs)
    errors = [nominal_error(setup, state_now.policy.merged()) for state_now in states]
    row["remarks"] += "; error " + ", ".join(f"{1000 * e:.1f}" for e in errors) + " mm"
    return row


def encode_and_pretrain(name: str) -> dict[str, Any]:
    """Time the training of the encoder and the policy for a vision preset."""
    setup, watch = Setup.from_preset(load(name)), Stopwatch()
    policy, _ = train(setup, 0)
    row = {"compile_s": watch.compile_s, "run_s": watch.total_s - watch.compile_s}
    return row | {"remarks": f"error {1000 * nominal_error(setup, policy):.1f} mm"}
