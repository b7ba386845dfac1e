"""Learn for a batch of flights on the virtual clock.

Only periods and latencies determine when learners are offered windows and when their updates become visible. Between
two such instants, all flights therefore run as one program. The same holds for the fits and the updates of all flights.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax, random
from jaxtyping import Array, Key

from ..adapt.gate import Verdict
from ..adapt.learner import OnlineLearner
from ..adapt.learner_state import FitReport, LearnerState
from ..adapt.updates import Layer, Skip, Update
from ..adapt.workers import PolicyWorker, ResidualWorker, policy_update, residual_update
from ..control.controller import AbstractController
from ..learn.bptt import PolicyState
from ..learn.devices import shard
from ..learn.window import Window
from ..physics.state import where
from .adaptive import AdaptivePilot
from .batched import Batch
from .events import Event
from .lockstep import LockstepLearner

AT_ONCE = 4  # largest number of updates that a core computes at once
IN_CACHE = 750_000  # bytes of the policies that a core trains at once, without their activations
RESIDUAL, POLICY = 0, 1
LAYERS: tuple[Layer, Layer] = ("residual", "policy")
"""Layers, in the order in which a pilot polls their learners."""


class Offer(NamedTuple):
    """A window that is offered to a learner, and the time at which its update becomes visible."""

    tick: int
    visible: int | None
    """Tick at which its update becomes visible; None if the learner is busy."""


def offers(period: int, latency: int, ticks: int) -> list[Offer]:
    """Return every offer to a learner during a flight.

    Args:
        period: Time between offers [ticks].
        latency: Time from an offer to its update [ticks].
        ticks: Length of the flight.
    """
    result, free = list[Offer](), 0
    for tick in range(period, ticks, period):
        busy = tick < free
        free = free if busy else tick + latency
        result.append(Offer(tick, None if busy else free))
    return result


@dataclass(frozen=True)
class Plan:
    """Settings of a pilot that learns on the virtual clock, as plain values."""

    learner: OnlineLearner
    controller: Callable[[LearnerState], AbstractController[Any]]
    key: Key[Array, ""]
    """Seed of the policy updates."""
    window: int
    periods: tuple[int, int]
    """Periods of the two layers [ticks]."""
    latencies: tuple[int, int]

    @classmethod
    def of(cls, pilot: AdaptivePilot) -> "Plan | None":
        """Return a pilot's plan; return None if the pilot has different learners, or if its latencies are measured."""
        learners = [each.learner for each in pilot.learners]
        if [type(getattr(each, "worker", None)) for each in learners] != [ResidualWorker, PolicyWorker]:
            return None  # a worker of a different class may compute something else
        match learners:
            case [
                LockstepLearner(worker=ResidualWorker(learner=other), latency_s=float(first)) as fit,
                LockstepLearner(worker=PolicyWorker(learner=learner, key=key), latency_s=float(second)) as update,
            ] if other is learner and isinstance(learner, OnlineLearner):
                latencies = fit.ticks(first), update.ticks(second)
                periods = pilot.periods[RESIDUAL], pilot.periods[POLICY]
                return cls(learner, pilot.controller_of, key, pilot.window, periods, latencies)
            case _:
                return None

    def same_as(self, other: "Plan") -> bool:
        """Return whether two plans are equal, except for their seeds."""
        mine, theirs = ((p.controller, p.window, p.periods, p.latencies) for p in (self, other))
        return self.learner is other.learner and mine == theirs


def fly_and_learn(
    batch: Batch, plans: Sequence[Plan], state: LearnerState, *, cold: bool
) -> tuple[LearnerState, list[list[Event]]]:
    """Fly a batch to its end, and learn during the flights.

    Args:
        batch: Flights that have not begun.
        plans: One plan for each flight; they are equal except for their seeds.
        state: Learner state of each flight at its start (leading axis flights).
        cold: Whether the programs are not compiled yet; if so, those for flight and for learning are compiled at the
            same time.

    Returns:
        The learner state of each flight at its end, and the events of each flight.
    """
    plan, keys = plans[0], shard(jnp.stack([each.key for each in plans]))
    batch.controllers = _controllers(plan, state)
    if cold:
        with ThreadPoolExecutor(1) as beside:
            compiled = beside.submit(_learn_from_nothing, plan.learner, state, batch.blank_window(plan.window), keys)
            batch.fly_to(1)
            compiled.result()
    pending: dict[int, tuple[Any, list[Update]]] = {}
    events = [list[Event]() for _ in plans]
    for instant in _instants(plan, batch.ticks):
        tick, _, layer, offer = instant
        if instant.published:
            learnt, updates = pending.pop(layer)
            policy, residual = (state.policy, learnt) if layer == RESIDUAL else (learnt, state.residual)
            batch.fly_to(tick)
            state = LearnerState(policy, residual)
            batch.controllers = _controllers(plan, state)
        elif offer.visible is None:
            updates = [Skip(tick * batch.dt, LAYERS[layer])] * len(plans)
        else:
            batch.fly_to(tick + 1)
            window = batch.window(tick, plan.window)
            if layer == RESIDUAL:
                pending[layer] = _fitted(plan.learner, state, window)
            else:
                keys, trained, updates = _updated(plan.learner, state, window, keys)
                pending[layer] = trained, updates
            continue
        for told, update in zip(events, updates, strict=True):
            told.append(Event.of(tick * batch.dt, update))
    batch.fly_to(batch.ticks)
    return state, events


def _learn_from_nothing(learner: OnlineLearner, state: LearnerState, window: Window, keys: Key[Array, " n"]) -> None:
    """Compile the learning programs, and drop their results."""
    _fitted(learner, state, window)
    _updated(learner, state, window, keys)


class _Instant(NamedTuple):
    """An offer or a publication during the flights; sorted instants follow the order in which a pilot handles them."""

    tick: int
    order: int
    """0 if an update is published, before the tick; 1 if a window is offered, after the command."""
    layer: int
    offer: Offer

    @property
    def published(self) -> bool:
        return self.order == 0


def _instants(plan: Plan, ticks: int) -> list[_Instant]:
    result = list[_Instant]()
    for layer in (RESIDUAL, POLICY):
        for offer in offers(plan.periods[layer], plan.latencies[layer], ticks):
            result.append(_Instant(offer.tick, 1, layer, offer))
            if offer.visible is not None and offer.visible < ticks:
                result.append(_Instant(offer.visible, 0, layer, offer))
    return sorted(result, key=lambda instant: instant[:3])


def _controllers(plan: Plan, state: LearnerState) -> Any:
    return eqx.filter_vmap(plan.controller)(state)


def _fitted(learner: OnlineLearner, state: LearnerState, window: Window) -> tuple[Any, list[Update]]:
    """Fit the residual of every flight; return the states and one update per flight, which holds all states."""
    states, reports = fit_all(learner, state.residual, window)
    reports, t = jax.device_get((reports, window.t[:, -1]))
    return states, [residual_update(float(t[i]), states, row(reports, i)) for i in range(len(t))]


def _updated(
    learner: OnlineLearner, state: LearnerState, window: Window, keys: Key[Array, " n"]
) -> tuple[Key[Array, " n"], Any, list[Update]]:
    """Re-train the policy of every flight; a flight keeps its old policy if the gate refuses the new one."""
    keys, now = _next_keys(keys)
    trained, verdicts = update_all(learner, state, window, now)
    verdicts, t = jax.device_get((verdicts, window.t[:, -1]))
    return keys, trained, [policy_update(float(t[i]), trained, row(verdicts, i)) for i in range(len(t))]


def row(tree: Any, i: int) -> Any:
    """Return one flight's entry from NumPy arrays with a leading axis of flights."""
    return jax.tree.map(lambda leaf: leaf[i], tree)


@eqx.filter_jit
def fit_all(learner: OnlineLearner, residuals: Any, windows: Window) -> tuple[Any, FitReport]:
    """Fit the residual of each flight; every array has a leading axis of flights."""
    fitted: tuple[Any, FitReport] = eqx.filter_vmap(learner.fit_residual)(residuals, windows)
    return fitted


@eqx.filter_jit
def update_all(
    learner: OnlineLearner, state: LearnerState, windows: Window, keys: Key[Array, " n"], flown: Any = None
) -> tuple[PolicyState, Verdict]:
    """Re-train the policy of each flight; every array has a leading axis of flights.

    Args:
        learner: The learner of all flights.
        state: State of each learner before the update.
        windows: Window of each flight.
        keys: Random keys, consumed.
        flown: Policies in flight, if they differ from those of ``state``.

    Returns:
        The trained policies, or the old ones where the gate refused them, and the verdicts.
    """

    def update(state: LearnerState, window: Window, key: Key[Array, ""], flown: Any) -> tuple[PolicyState, Verdict]:
        trained, verdict = learner.update_policy(state.policy, state.residual, window, key, flown)
        return where(verdict.admitted, trained, state.policy), verdict

    if jax.default_backend() != "cpu" or jax.device_count() > 1:
        updated: tuple[PolicyState, Verdict] = eqx.filter_vmap(update)(state, windows, keys, flown)
        return updated
    # A core is fastest with a few updates at once, since their activations stay in its cache. The last group is padded.
    arrays, rest = eqx.partition((state, windows, keys, flown), eqx.is_array)
    n = keys.shape[0]
    few = at_once(n, sum(leaf.nbytes for leaf in jax.tree.leaves(eqx.filter(state.policy.policy, eqx.is_array))) // n)
    filled = jnp.minimum(jnp.arange(n + -n % few), n - 1)

    def of_arrays(one: Any) -> tuple[PolicyState, Verdict]:
        trained, verdict = update(*eqx.combine(one, rest))
        return eqx.filter(trained, eqx.is_array), verdict

    made = lax.map(of_arrays, jax.tree.map(lambda leaf: leaf[filled], arrays), batch_size=few)
    trained, verdicts = jax.tree.map(lambda leaf: leaf[:n], made)
    return eqx.combine(trained, eqx.filter(state.policy, eqx.is_array, inverse=True)), verdicts


def at_once(n: int, size: int) -> int:
    """Return the number of updates that a core computes at once: few enough for its cache, with little padding.

    Args:
        n: Number of updates.
        size: Size of a policy [bytes].
    """
    most = min(n, AT_ONCE, IN_CACHE // size)
    return max(range(2, most + 1), key=lambda few: (-(-n % few), few), default=1)


@jax.jit
def _next_keys(keys: Key[Array, " n"]) -> tuple[Key[Array, " n"], Key[Array, " n"]]:
    """Return the keys with which to continue, and the keys of an update."""
    both = jax.vmap(random.split)(keys)
    return both[:, 0], both[:, 1]
