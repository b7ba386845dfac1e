"""Flies the flights of a fleet, one by one, or in batches that each run as one program."""

from collections.abc import Callable, Hashable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from ..adapt.learner_state import LearnerState
from ..config.methods import find_method
from ..config.setup import Latency, Setup
from ..physics.state import State
from ..plants.plant import Plant
from ..plants.sim import SimPlant
from ..progress import no_progress
from ..runtime.adaptive import AdaptivePilot
from ..runtime.events import Event
from ..runtime.flight import Log, States, fly
from ..runtime.pilot import Pilot
from ..runtime.together import can_fly_together, fly_together
from ..tasks.task import AbstractTask
from .flights import Flight, FlightSpec

FLOOR = -0.5  # [m]: a flight below this is terminated; starts may lie at z = 0, and a transient dips below them


def plant_of(setup: Setup, spec: FlightSpec) -> Plant:
    """Return a flight's plant, with the method's on-board controller, if any.

    Raises:
        ConfigError: The method cannot fly the plant.
        PlantError: A package is not installed.
    """
    preset = setup.preset
    plant = spec.scenario.make(preset.vehicle, dt=preset.dt, seed=spec.plant_seed)
    return find_method(spec.method).modify_plant(setup, plant)


def fly_one(
    setup: Setup,
    policy: Any,
    spec: FlightSpec,
    x0: State,
    seconds: float,
    *,
    latency: Latency = "fixed",
    state: LearnerState | None = None,
    stop: Any = None,
) -> Flight:
    """Fly one flight.

    Args:
        setup: Set-up of the policy's preset, with the scenario's reference.
        policy: A policy, or the network of a method that has its own.
        spec: Scenario, method and seeds.
        x0: State at the start.
        seconds: Length of the flight [s].
        latency: How learning is charged to flight time.
        state: Learner state from an earlier flight, to resume from.
        stop: A ``threading.Event`` that aborts the flight.

    Raises:
        PlantError: The plant refused to fly.
        FlightStopped: ``stop`` was set.
    """
    preset, task = setup.preset, setup.flight_task
    pilot = setup.pilot(policy, spec.method, spec.key(), latency=latency, state=state)
    plant = plant_of(setup, spec)

    def terminated(t: float, x: State) -> bool:
        return bool(_terminated(task, np.float64(t), x))

    log = fly(
        plant, pilot, x0, ticks=round(seconds / preset.dt), terminated=terminated, stop=stop, progress=no_progress
    )
    return score_flight(setup, spec, log, learner_state_of(pilot))


def program_of(setup: Setup, policy: Any, specs: Sequence[FlightSpec]) -> Hashable:
    """Return a key that identifies the program for a batch of flights that differ only in start and seed.

    Only the first two flights are checked.

    Returns:
        The key; None if the flights cannot run as one program.

    Raises:
        PlantError: The plant's package is not installed.
    """
    if len(specs) < 2:
        return None
    plants = [plant_of(setup, spec) for spec in specs[:2]]
    if not can_fly_together(plants, [setup.pilot(policy, spec.method, spec.key()) for spec in specs[:2]]):
        return None
    return specs[0].method, jax.tree.structure([plant.simulation for plant in plants if isinstance(plant, SimPlant)])


def fly_batch(
    setup: Setup,
    policies: Sequence[Any],
    specs: Sequence[FlightSpec],
    starts: Sequence[State],
    seconds: float,
    *,
    state: LearnerState | None = None,
    progress: Callable[[float], None] = lambda share: None,
    stop: Any = None,
    cold: bool = False,
) -> list[Flight]:
    """Fly flights as a batch; see :func:`program_of`.

    Args:
        setup: Set-up of the policies' preset, with the scenario's reference.
        policies: Policies or baseline networks, one for each flight.
        specs: Specifications with the same scenario and method, but different starts and seeds.
        starts: States at the start, one for each flight.
        seconds: Length of the flights [s].
        state: Learner state from an earlier flight, to resume from.
        progress: Called periodically with the completed share.
        stop: A ``threading.Event`` that aborts the flights.
        cold: Whether this is the first such batch, so that its programs are not yet compiled.

    Raises:
        FlightStopped: ``stop`` was set.
    """
    preset = setup.preset
    pilots = [setup.pilot(p, s.method, s.key(), state=state) for p, s in zip(policies, specs, strict=True)]
    plants = [plant_of(setup, spec) for spec in specs]
    if not can_fly_together(plants, pilots):  # the first two are alike, but a later one differs
        each = zip(policies, specs, starts, strict=True)
        return [fly_one(setup, policy, spec, x0, seconds, state=state, stop=stop) for policy, spec, x0 in each]
    sim_plants = [plant for plant in plants if isinstance(plant, SimPlant)]
    ticks = round(seconds / preset.dt)
    logs = fly_together(sim_plants, pilots, starts, ticks=ticks, progress=progress, stop=stop, cold=cold)
    return [
        score_flight(setup, spec, cut_at_termination(setup.flight_task, log), learner_state_of(pilot))
        for spec, log, pilot in zip(specs, logs, pilots, strict=True)
    ]


def cut_at_termination(task: AbstractTask, log: Log) -> Log:
    """Cut a log where the vehicle left the task's bounds; a batch does not stop there."""
    left = np.flatnonzero(np.asarray(_all_terminated(task, log.task_time, log.true.as_state()))[1:])
    if not len(left):
        return log
    rows = int(left[0]) + 2
    true, measurement = (States(*(part[:rows] for part in states)) for states in (log.true, log.measured))
    events = tuple(event for event in log.events if event.t < log.t[rows - 1])
    return Log(
        log.t[:rows],
        true,
        measurement,
        log.u[:rows],
        log.dt,
        True,
        events,
        np.broadcast_to(log.age, log.t.shape)[:rows],
        None if log.phase is None else log.phase[:rows],
    )


def learner_state_of(pilot: Pilot) -> LearnerState | None:
    """Return a pilot's learner state; None if the pilot does not learn."""
    return pilot.state if isinstance(pilot, AdaptivePilot) else None


def score_flight(setup: Setup, spec: FlightSpec, log: Log, learner_state: LearnerState | None = None) -> Flight:
    """Return a flight with its errors and, if it was terminated, the reason."""
    task = setup.flight_task
    error, cross, target = _errors(task, log.task_time, log.true.as_state())
    if log.terminated and not any(event.kind == "terminated" for event in log.events):
        why = Event(float(log.t[-1]), "terminated", _why(log, float(error[-1])))
        log = log._replace(events=(*log.events, why))
    return Flight(
        spec,
        spec.scenario.vehicle_name(setup.preset.vehicle),
        log,
        np.asarray(error),
        task.metric,
        task.steady_seconds,
        None if cross is None else np.asarray(cross),
        learner_state,
        np.asarray(target),
    )


def _why(log: Log, error: float) -> str:
    """Return the reason for a termination in words."""
    x, y, z = log.p[-1]
    if not all(np.isfinite(part[-1]).all() for part in log.true):
        return "the state is not finite"
    left = f"below {FLOOR:g} m, under the ground" if z < FLOOR else f"{error:.2f} m off, out of the task's bounds"
    return f"{left}, at ({x:.2f}, {y:.2f}, {z:.2f}) m"


def _out_of_bounds(task: AbstractTask, t: Any, x: State) -> Array:
    return task.terminated(jnp.asarray(t, dtype=x.p.dtype), x) | (x.p[2] < FLOOR)


_terminated = eqx.filter_jit(_out_of_bounds)


@eqx.filter_jit
def _all_terminated(task: AbstractTask, t: Any, x: State) -> Array:
    result: Array = jax.vmap(lambda t, x: _out_of_bounds(task, t, x))(t, x)
    return result


@eqx.filter_jit
def _errors(task: AbstractTask, t: Any, x: State) -> tuple[Array, Array | None, Array]:
    times = jnp.asarray(t, dtype=x.p.dtype)
    error = jax.vmap(task.error)(times, x)
    first = jax.eval_shape(task.cross_track, jax.tree.map(lambda leaf: leaf[0], x))
    return error, None if first is None else lax.map(task.cross_track, x), jax.vmap(task.target)(times)
