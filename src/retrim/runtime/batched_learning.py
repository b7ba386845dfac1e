"""Learn for a batch of flights on the virtual clock.

Only periods and latencies determine when learners are offered windows and when their updates become visible. Between
two such instants, all flights therefore run as one program. The same holds for the fits and the updates of all flights.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, NamedTuple

import equinox as eqx

from ..adapt.learner_state import LearnerState
from ..adapt.updates import Layer, Skip, Update
from ..adapt.worker import BatchUpdate, Worker, WorkerBatch
from ..control.controller import AbstractController
from .adaptive import AdaptivePilot
from .batched import Batch
from .events import Event

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
    """Workers and times of a pilot that learns on the virtual clock; one entry per layer."""

    controller: Callable[[LearnerState], AbstractController[Any]]
    workers: tuple[Worker, ...]
    window: int
    periods: tuple[int, ...]
    """Periods of the layers [ticks]."""
    latencies: tuple[int, ...]

    @classmethod
    def of(cls, pilot: AdaptivePilot) -> "Plan | None":
        """Return a pilot's plan; return None if one of its learners cannot learn in a batch of flights."""
        parts = [part for each in pilot.learners if (part := each.learner.batchable) is not None]
        workers = tuple(worker for worker, _ in parts)
        if len(parts) < len(pilot.learners) or tuple(worker.layer for worker in workers) != LAYERS:
            return None
        if any(worker.learner is not workers[0].learner for worker in workers):
            return None
        latencies = tuple(latency for _, latency in parts)
        return cls(pilot.controller_of, workers, pilot.window, tuple(pilot.periods), latencies)

    def same_as(self, other: "Plan") -> bool:
        """Return whether two plans are equal, except for the states and random keys of their workers."""
        mine, theirs = (
            (p.controller, [type(worker) for worker in p.workers], p.window, p.periods, p.latencies)
            for p in (self, other)
        )
        return mine == theirs and self.workers[0].learner is other.workers[0].learner


def fly_and_learn(
    batch: Batch, plans: Sequence[Plan], state: LearnerState, *, cold: bool
) -> tuple[LearnerState, list[list[Event]]]:
    """Fly a batch to its end, and learn during the flights.

    Args:
        batch: Flights that have not begun.
        plans: One plan for each flight; they are equal except for the states and random keys of their workers.
        state: Learner state of each flight at its start (leading axis flights).
        cold: Whether the programs are not compiled yet; if so, those for flight and for learning are compiled at the
            same time.

    Returns:
        The learner state of each flight at its end, and the events of each flight.
    """
    plan, batches = plans[0], _stack(plans)
    batch.controllers = _controllers(plan, state)
    if cold:
        with ThreadPoolExecutor(1) as beside:
            program = beside.submit(_compile, batch, plans, state)
            batch.fly_to(1)
            program.result()
    pending = dict[int, BatchUpdate]()
    events = [list[Event]() for _ in plans]
    for instant in _instants(plan, batch.ticks):
        tick, _, layer, offer = instant
        if instant.published:
            update = pending.pop(layer)
            policy, residual = (state.policy, update.states) if layer == RESIDUAL else (update.states, state.residual)
            batch.fly_to(tick)
            state = LearnerState(policy, residual)
            batch.controllers = _controllers(plan, state)
            messages = [update.message(i, update.states) for i in range(len(plans))]
        elif offer.visible is None:
            messages = list[Update]([Skip(tick * batch.dt, LAYERS[layer])] * len(plans))
        else:
            batch.fly_to(tick + 1)
            states = plan.workers[layer].state_in(state)
            pending[layer] = batches[layer].learn(states, batch.window(tick, plan.window))
            continue
        for of_flight, message in zip(events, messages, strict=True):
            of_flight.append(Event.of(tick * batch.dt, message))
    batch.fly_to(batch.ticks)
    for layer, learners in enumerate(batches):
        learners.unstack([each.workers[layer] for each in plans])
    return state, events


def _stack(plans: Sequence[Plan]) -> list[WorkerBatch]:
    """Return the batch of each layer; plans contain only workers that form batches."""
    layers = list(zip(*(plan.workers for plan in plans), strict=True))
    return [kind.of(workers) for workers in layers if (kind := workers[0].batch) is not None]


def _compile(batch: Batch, plans: Sequence[Plan], state: LearnerState) -> None:
    """Compile the learning programs, and drop their results."""
    window = batch.blank_window(plans[0].window)
    for worker, workers in zip(plans[0].workers, _stack(plans), strict=True):
        workers.learn(worker.state_in(state), window)


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
