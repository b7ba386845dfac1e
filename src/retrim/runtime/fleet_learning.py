"""Learn for many vehicles at once, with one program for all due updates and a base that all vehicles share."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jax import random
from jaxtyping import Array, Key

from ..adapt.learner import OnlineLearner
from ..adapt.learner_state import LearnerState
from ..adapt.updates import PolicyUpdate, Update
from ..adapt.worker import Worker
from ..adapt.workers import PolicyWorker, ResidualWorker, policy_update, residual_update
from ..control.lora import LoraPolicy
from ..control.policy import Policy
from ..learn.bptt import PolicyState, policy_gradient
from ..learn.devices import shard, to_default_device
from ..learn.residuals.model import FittedResidual
from ..learn.window import Window
from .batch_learning import fit_all, row, update_all
from .batched import one, stacked


def learn_together(
    workers: Sequence[Worker], windows: Sequence[Window], base: PolicyState | None = None
) -> list[Update]:
    """Learn from one window for each of several vehicles.

    Custom workers learn one after another. Each vehicle's result equals that of its worker alone, up to rounding.
    Programs are compiled for batch sizes that are powers of two. Copies pad the batch to the next power, and their
    results are dropped, so any number of vehicles may be due.

    Args:
        workers: One worker for each vehicle. All have the same layer and learner, and states of the same structure.
        windows: The window of each worker.
        base: The base to which low-rank policies add their deltas from now on; by default, each keeps its own. The gate
            compares the result with the policy in flight.

    Returns:
        The update of each vehicle.
    """
    first, n = workers[0], len(workers)
    if type(first) not in (ResidualWorker, PolicyWorker):
        return [worker.learn(window) for worker, window in zip(workers, windows, strict=True)]
    filled = [*range(n), *[0] * (room_for(n) - n)]
    window = stacked([windows[i] for i in filled])
    if isinstance(first, ResidualWorker):
        states, reports = fit_all(first.learner, stacked([_state(workers[i]) for i in filled]), window)
        reports, t = jax.device_get((reports, window.t[:, -1]))
        return [residual_update(float(t[i]), one(states, i), row(reports, i)) for i in range(n)]
    assert isinstance(first, PolicyWorker)
    keys = [worker.next_key() for worker in workers if isinstance(worker, PolicyWorker)]
    state = stacked([_on(_state(workers[i]), base) for i in filled])
    flown = None if base is None else stacked([_policy(workers[i]) for i in filled])
    trained, verdicts = update_all(first.learner, state, window, shard(jnp.stack([keys[i] for i in filled])), flown)
    verdicts, t = jax.device_get((verdicts, window.t[:, -1]))
    return [policy_update(float(t[i]), one(trained, i), row(verdicts, i)) for i in range(n)]


def shared_base(learner: OnlineLearner, state: LearnerState) -> PolicyState:
    """Return a low-rank policy's base with a fresh optimiser, for all vehicles that start from it."""
    policy = state.policy.policy
    assert isinstance(policy, LoraPolicy)
    return PolicyState(policy.base, _optimiser(learner).init(policy.base.params))


def learn_base(
    workers: Sequence[PolicyWorker], windows: Sequence[Window], base: PolicyState, key: Key[Array, ""]
) -> PolicyState:
    """Take one optimiser step on a shared base, along the mean gradient of several vehicles.

    Each vehicle contributes the gradient of its own policy (base plus delta) in its own corrected model. Since the
    delta is added to the base, this is also the gradient with respect to the base.

    Args:
        workers: One worker for each vehicle, with low-rank policies.
        windows: The window of each vehicle.
        base: The base, and its optimiser.
        key: Random key, consumed.

    Returns:
        The base after the step, or the unchanged base if the gradient is not finite.
    """
    n = len(workers)
    filled = [*range(n), *[0] * (room_for(n) - n)]
    states = stacked([_on(workers[i].state, base) for i in filled])
    weight = jnp.asarray([1.0 / n] * n + [0.0] * (len(filled) - n))
    window = stacked([windows[i] for i in filled])
    stepped: PolicyState = _base_step(workers[0].learner, base, states, window, weight, key)
    return to_default_device(stepped)  # the next step may be shared by other devices


def refused_by_all(updates: Sequence[Update]) -> bool:
    """Return whether every vehicle refused its update; the step of the shared base is then undone."""
    return not any(isinstance(update, PolicyUpdate) for update in updates)


@eqx.filter_jit
def _base_step(
    learner: OnlineLearner, base: PolicyState, states: LearnerState, windows: Window, weight: Array, key: Key[Array, ""]
) -> PolicyState:
    def gradient(state: LearnerState, window: Window, key: Key[Array, ""]) -> Any:
        corrected = learner.view(learner.env, FittedResidual(learner.residual_model, state.residual))
        x0 = jax.tree.map(lambda leaf: leaf[0], learner.starts(learner.env.task, window, key, 1, learner.num_envs))
        return policy_gradient(state.policy.policy.merged(), corrected, x0)[1]

    each = eqx.filter_vmap(gradient)(states, windows, random.split(key, weight.shape[0]))
    mean = jax.tree.map(lambda leaf: jnp.tensordot(weight.astype(leaf.dtype), leaf, axes=1), each)
    params = base.policy.params
    change, memory = _optimiser(learner).update(mean, base.optimiser, params)
    stepped = PolicyState(base.policy.with_params(optax.apply_updates(params, change)), memory)
    fine = jnp.isfinite(optax.tree.norm(mean))
    result: PolicyState = jax.tree.map(lambda new, old: jnp.where(fine, new, old), stepped, base)
    return result


def _optimiser(learner: OnlineLearner) -> optax.GradientTransformation:
    """Return one Adam for the whole flight, at the rate for all weights; updates of the base do not reset it."""
    clip = optax.clip_by_global_norm(learner.optimiser.max_grad_norm)
    return optax.chain(clip, optax.scale_by_adam(), optax.scale_by_learning_rate(learner.optimiser.rate))


def _on(state: Any, base: PolicyState | None) -> Any:
    """Put a low-rank policy's delta on a different base."""
    if base is None or not isinstance(state, LearnerState) or not isinstance(state.policy.policy, LoraPolicy):
        return state
    assert isinstance(base.policy, Policy)
    policy = dataclasses.replace(state.policy.policy, base=base.policy)
    return LearnerState(PolicyState(policy, state.policy.optimiser), state.residual)


def room_for(n: int) -> int:
    """Return the size of the program for ``n`` vehicles: the next power of two."""
    return 1 << (n - 1).bit_length()


def _state(worker: Worker) -> Any:
    assert isinstance(worker, ResidualWorker | PolicyWorker)
    return worker.state


def _policy(worker: Worker) -> Any:
    assert isinstance(worker, PolicyWorker)
    return worker.policy
