"""Fly many flights in step, as one batch. Each flight equals the flight of its pilot alone."""

import threading
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax

from ..learn.stacking import stack, unstack
from ..physics.state import State
from ..plants.plant import Plant
from ..plants.sim import SimPlant
from .adaptive import AdaptivePilot
from .batched import Batch
from .batched_learning import Plan, fly_and_learn
from .events import Event
from .flight import Log
from .pilot import ControllerPilot, Pilot


def can_fly_together(plants: Sequence[Plant], pilots: Sequence[Pilot]) -> bool:
    """Return whether flights can form one batch: simulated plants of one structure, and pilots of one kind.

    Such pilots have controllers of the same structure, or share one learner on the virtual clock with fixed latencies.
    """
    simulations = [plant.simulation for plant in plants if type(plant) is SimPlant]
    has_dropouts = any(each.fault is not None and each.fault.interrupts for each in simulations)
    if len(simulations) < len(plants) or has_dropouts or not _alike(simulations):
        return False
    controllers = [pilot.controller for pilot in pilots if type(pilot) is ControllerPilot]
    if controllers:
        return len(controllers) == len(pilots) and _alike(controllers)
    learning = [pilot for pilot in pilots if type(pilot) is AdaptivePilot]
    plans = [plan for pilot in learning if (plan := Plan.of(pilot)) is not None]
    alike = len(plans) == len(pilots) and all(plan.same_as(plans[0]) for plan in plans)
    return alike and _alike([pilot.state for pilot in learning])


def fly_together(
    plants: Sequence[SimPlant],
    pilots: Sequence[Pilot],
    starts: Sequence[State],
    *,
    ticks: int,
    progress: Callable[[float], None] = lambda share: None,
    stop: threading.Event | None = None,
    cold: bool = False,
) -> list[Log]:
    """Fly a batch. Flights never terminate early; afterwards, adaptive pilots hold their new learner states.

    Args:
        plants: One plant for each flight.
        pilots: One pilot for each flight; :func:`can_fly_together` must be true for them.
        starts: State at the start of each flight.
        ticks: Length of the flights [ticks].
        progress: Function that is called from time to time with the completed share of the flights.
        stop: Event that aborts the flights; set it from another thread.
        cold: Whether this is the first such batch; if so, the programs for flight and for learning are compiled at the
            same time.

    Returns:
        A log for each flight, with one more row than ticks.

    Raises:
        FlightStopped: ``stop`` was set.
    """
    batch = Batch([plant.simulation for plant in plants], starts, ticks, plants[0].dt, progress, stop)
    learning = [pilot for pilot in pilots if isinstance(pilot, AdaptivePilot)]
    events: Sequence[Sequence[Event]]
    if learning:
        plans, start = [_plan(pilot) for pilot in learning], stack([pilot.state for pilot in learning])
        states, events = fly_and_learn(batch, plans, start, cold=cold)
        for i, pilot in enumerate(learning):
            pilot.learn(unstack(states, i), ticks * batch.dt)
    else:
        batch.controllers = stack([pilot.controller for pilot in pilots if isinstance(pilot, ControllerPilot)])
        batch.fly_to(ticks)
        events = [()] * len(pilots)
    return [batch.log(i, events[i]) for i in range(len(pilots))]


def _alike(trees: Sequence[Any]) -> bool:
    """Return whether trees can be stacked: equal structures, shapes, types and static parts."""
    kinds = [eqx.partition(tree, eqx.is_array) for tree in trees]
    shapes = [[(leaf.shape, leaf.dtype) for leaf in jax.tree.leaves(arrays)] for arrays, _ in kinds]
    return all(bool(eqx.tree_equal(static, kinds[0][1])) for _, static in kinds) and all(s == shapes[0] for s in shapes)


def _plan(pilot: AdaptivePilot) -> Plan:
    plan = Plan.of(pilot)
    if plan is None:
        raise ValueError("fly_together: a pilot with measured latency flies alone")
    return plan
