"""Learn for many vehicles at once: one program for all fits or updates, and a low-rank base that the vehicles share."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jax import lax, random
from jaxtyping import Array, Key

from ..learn.bptt import PolicyState, policy_gradient
from ..learn.devices import shard, to_default_device
from ..learn.residuals.model import FittedResidual
from ..learn.stacking import stack
from ..learn.window import Window
from ..physics.state import where
from .gate import Verdict
from .learner import OnlineLearner
from .learner_state import FitReport, LearnerState
from .updates import PolicyUpdate, Update, policy_update, residual_update
from .worker import BatchUpdate, Worker, WorkerBatch

BATCH = 4  # largest number of updates that a core computes at once
IN_CACHE = 750_000  # bytes of the policies that a core trains at once, without their activations


class ResidualBatch(WorkerBatch):
    """Fits the residuals of several vehicles."""

    def __init__(self, learner: OnlineLearner) -> None:
        self.learner = learner

    @classmethod
    def of(cls, workers: Sequence[Any]) -> "ResidualBatch":
        """Return the batch of residual workers with one learner."""
        return cls(workers[0].learner)

    def learn(self, states: Any, windows: Window, incumbents: Any = None) -> BatchUpdate:
        """Fit the residual of each vehicle; ``states`` are the states of the residual models."""
        residuals, reports = _fit_all(self.learner, states, windows)
        reports, t = jax.device_get((reports, windows.t[:, -1]))
        return BatchUpdate(residuals, lambda i, state: residual_update(float(t[i]), state, _row(reports, i)))

    def unstack(self, workers: Sequence[Any]) -> None:
        """Do nothing, since a fit uses no random numbers."""


class PolicyBatch(WorkerBatch):
    """Re-trains the policies of several vehicles; ``keys`` are the random keys of their workers."""

    def __init__(self, learner: OnlineLearner, keys: Key[Array, " n"]) -> None:
        self.learner, self.keys = learner, keys

    @classmethod
    def of(cls, workers: Sequence[Any]) -> "PolicyBatch":
        """Return the batch of policy workers with one learner, which starts from their random keys."""
        return cls(workers[0].learner, shard(jnp.stack([worker.key for worker in workers])))

    def learn(self, states: LearnerState, windows: Window, incumbents: Any = None) -> BatchUpdate:
        """Re-train the policy of each vehicle; a vehicle keeps its old policy if the gate refuses the new one."""
        self.keys, now = _next_keys(self.keys)
        trained_states, verdicts = _update_all(self.learner, states, windows, now, incumbents)
        verdicts, t = jax.device_get((verdicts, windows.t[:, -1]))
        return BatchUpdate(trained_states, lambda i, state: policy_update(float(t[i]), state, _row(verdicts, i)))

    def unstack(self, workers: Sequence[Any]) -> None:
        """Let the workers continue with the next random keys."""
        data = jax.device_get(random.key_data(self.keys))
        for i, worker in enumerate(workers):
            worker.key = random.wrap_key_data(jax.device_put(data[i]), impl=random.key_impl(self.keys))


def learn_together(
    workers: Sequence[Worker], windows: Sequence[Window], base: PolicyState | None = None
) -> list[Update]:
    """Learn from one window for each of several vehicles.

    Workers without a batch learn one after another. Each vehicle's result equals that of its worker alone, up to
    rounding. Programs are compiled for batch sizes that are powers of two. Copies pad the batch to the next power, and
    their results are dropped, so any number of vehicles may be due.

    Args:
        workers: One worker for each vehicle. All have the same class and learner, and states of the same structure.
        windows: The window of each worker.
        base: The base to which low-rank policies add their deltas from now on; by default, each keeps its own. The gate
            compares the result with the policy in flight.

    Returns:
        The update of each vehicle.
    """
    kind = workers[0].batch
    if kind is None:
        return [worker.learn(window) for worker, window in zip(workers, windows, strict=True)]
    numbers = _pad_numbers(len(workers))
    batch = kind.of([workers[i] for i in numbers])
    states = [worker.state for worker in workers]
    incumbents = None if base is None else stack([states[i].policy.policy for i in numbers])
    together = stack([states[i] if base is None else _on(states[i], base) for i in numbers])
    update = batch.learn(together, stack([windows[i] for i in numbers]), incumbents)
    batch.unstack(workers)
    return update.unstack(len(workers))


def shared_base(worker: Worker) -> PolicyState:
    """Return the base of a worker's low-rank policy with a fresh optimiser, for all vehicles that start from it.

    Raises:
        ValueError: The worker does not train a low-rank policy.
    """
    if worker.low_rank is None:
        raise ValueError("shared_base: the worker must train a low-rank policy; other policies have no base to share")
    return PolicyState(worker.low_rank.base, _optimiser(worker.learner).init(worker.low_rank.base.params))


def learn_base(
    workers: Sequence[Worker], windows: Sequence[Window], base: PolicyState, key: Key[Array, ""]
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
    n, numbers = len(workers), _pad_numbers(len(workers))
    states = stack([_on(workers[i].state, base) for i in numbers])
    weight = jnp.asarray([1.0 / n] * n + [0.0] * (len(numbers) - n))
    window = stack([windows[i] for i in numbers])
    new_base: PolicyState = _base_step(workers[0].learner, base, states, window, weight, key)
    return to_default_device(new_base)  # the next step may be shared by other devices


def all_refuse(updates: Sequence[Update]) -> bool:
    """Return whether every vehicle refused its update; the step of the shared base is then undone."""
    return not any(isinstance(update, PolicyUpdate) for update in updates)


def room_for(n: int) -> int:
    """Return the size of the program for ``n`` vehicles: the next power of two."""
    return 1 << (n - 1).bit_length()


def at_once(n: int, size: int) -> int:
    """Return the number of updates that a core computes at once: few enough for its cache, with little padding.

    Args:
        n: Number of updates.
        size: Size of a policy [bytes].
    """
    most = min(n, BATCH, IN_CACHE // size)
    return max(range(2, most + 1), key=lambda few: (-(-n % few), few), default=1)


def _pad_numbers(n: int) -> list[int]:
    """Return the numbers of ``n`` vehicles, followed by copies of the first one that fill the program."""
    return [*range(n), *[0] * (room_for(n) - n)]


def _on(state: LearnerState, base: PolicyState) -> LearnerState:
    """Put a low-rank policy's delta on a different base."""
    low_rank: Any = state.policy.policy
    policy = dataclasses.replace(low_rank, base=base.policy)
    return LearnerState(PolicyState(policy, state.policy.optimiser), state.residual)


def _row(tree: Any, i: int) -> Any:
    """Return one vehicle's entry from NumPy arrays with a leading axis of vehicles."""
    return jax.tree.map(lambda leaf: leaf[i], tree)


def _optimiser(learner: OnlineLearner) -> optax.GradientTransformation:
    """Return one Adam for the whole flight, at the rate for all weights; updates of the base do not reset it."""
    clip = optax.clip_by_global_norm(learner.optimiser.max_grad_norm)
    return optax.chain(clip, optax.scale_by_adam(), optax.scale_by_learning_rate(learner.optimiser.rate))


@jax.jit
def _next_keys(keys: Key[Array, " n"]) -> tuple[Key[Array, " n"], Key[Array, " n"]]:
    """Return the keys with which to continue, and the keys of an update."""
    both = jax.vmap(random.split)(keys)
    return both[:, 0], both[:, 1]


@eqx.filter_jit
def _fit_all(learner: OnlineLearner, residuals: Any, windows: Window) -> tuple[Any, FitReport]:
    """Fit the residual of each vehicle; every array has a leading axis of vehicles."""
    result: tuple[Any, FitReport] = eqx.filter_vmap(learner.fit_residual)(residuals, windows)
    return result


@eqx.filter_jit
def _update_all(
    learner: OnlineLearner, state: LearnerState, windows: Window, keys: Key[Array, " n"], incumbents: Any
) -> tuple[PolicyState, Verdict]:
    """Return the trained policies, or the old ones where the gate refused them, and the verdicts."""

    def update(state: LearnerState, window: Window, key: Key[Array, ""], incumbent: Any) -> tuple[PolicyState, Verdict]:
        trained_state, verdict = learner.update_policy(state.policy, state.residual, window, key, incumbent)
        return where(verdict.admitted, trained_state, state.policy), verdict

    if jax.default_backend() != "cpu" or jax.device_count() > 1:
        result: tuple[PolicyState, Verdict] = eqx.filter_vmap(update)(state, windows, keys, incumbents)
        return result
    # A core is fastest with a few updates at once, since their activations stay in its cache. The last group is padded.
    arrays, rest = eqx.partition((state, windows, keys, incumbents), eqx.is_array)
    n = keys.shape[0]
    few = at_once(n, sum(leaf.nbytes for leaf in jax.tree.leaves(eqx.filter(state.policy.policy, eqx.is_array))) // n)
    indices = jnp.minimum(jnp.arange(n + -n % few), n - 1)

    def of_arrays(one: Any) -> tuple[PolicyState, Verdict]:
        trained_state, verdict = update(*eqx.combine(one, rest))
        return eqx.filter(trained_state, eqx.is_array), verdict

    results = lax.map(of_arrays, jax.tree.map(lambda leaf: leaf[indices], arrays), batch_size=few)
    trained_states, verdicts = jax.tree.map(lambda leaf: leaf[:n], results)
    return eqx.combine(trained_states, eqx.filter(state.policy, eqx.is_array, inverse=True)), verdicts


@eqx.filter_jit
def _base_step(
    learner: OnlineLearner, base: PolicyState, states: LearnerState, windows: Window, weight: Array, key: Key[Array, ""]
) -> PolicyState:
    def gradient(state: LearnerState, window: Window, key: Key[Array, ""]) -> Any:
        corrected_env = learner.view(learner.env, FittedResidual(learner.residual_model, state.residual))
        x0 = jax.tree.map(lambda leaf: leaf[0], learner.starts(learner.env.task, window, key, 1, learner.num_envs))
        return policy_gradient(state.policy.policy.merged(), corrected_env, x0)[1]

    each = eqx.filter_vmap(gradient)(states, windows, random.split(key, weight.shape[0]))
    mean = jax.tree.map(lambda leaf: jnp.tensordot(weight.astype(leaf.dtype), leaf, axes=1), each)
    params = base.policy.params
    change, memory = _optimiser(learner).update(mean, base.optimiser, params)
    new_base = PolicyState(base.policy.with_params(optax.apply_updates(params, change)), memory)
    fine = jnp.isfinite(optax.tree.norm(mean))
    result: PolicyState = jax.tree.map(lambda new, old: jnp.where(fine, new, old), new_base, base)
    return result
