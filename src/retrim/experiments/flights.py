"""One flight of a fleet: its specification, how it is flown, and what it leaves."""

from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax, random
from jaxtyping import Array, Key

from ..adapt.learner import LearnerState
from ..config.scenario import Scenario
from ..config.setup import Latency, Setup
from ..control.lora import LoraPolicy
from ..control.policy import Policy
from ..physics.state import State
from ..runtime.adaptive import AdaptivePilot
from ..runtime.events import Event, Observer
from ..runtime.flight import Log, fly
from ..tasks.task import AbstractTask

FLOOR = -0.5  # [m]: a vehicle below this is terminated; starts may lie at z = 0, and a transient dips below them
SETTLED = 0.05  # [m]
LEARNER_TAG = 2**30 + 2  # folded into a seed: learners share no key with training, starts and disturbances


@dataclass(frozen=True)
class FlightSpec:
    """One flight to fly."""

    scenario: Scenario
    method: str
    start: int
    """Number of the start; it also seeds the learners, the gusts and the noise of the flight."""
    seed: int = 0
    """Seed of the policy; it also seeds all that ``start`` does."""

    def key(self) -> Key[Array, ""]:
        """Return the key of the flight's learners."""
        return random.fold_in(random.fold_in(random.key(self.seed), LEARNER_TAG), self.start)

    @property
    def plant_seed(self) -> int:
        """Seed of the plant: the same gusts and noise for every method that flies from a start."""
        return 1000 * self.seed + self.start


@dataclass(frozen=True)
class Flight:
    """One flight flown."""

    spec: FlightSpec
    vehicle: str
    """Name of the vehicle that flew."""
    log: Log
    error: np.ndarray
    """The task's error in each row of the log [m]."""
    metric: str
    """Name of the error."""
    steady_seconds: float
    """The flight is scored over this long at its end [s]."""
    cross: np.ndarray | None = None
    """Distance from the nearest point of the reference in each row [m], if the task has one."""
    learnt: LearnerState | None = None
    """What a flight that adapted has learnt."""

    @property
    def steady(self) -> float:
        """Mean error over the last seconds [m]; NaN for a flight that was terminated."""
        return self._last(self.error)

    @property
    def peak(self) -> float:
        """Largest error after the first 5 s [m]; infinite for a flight that was terminated."""
        late = self.error[self.log.t >= min(5.0, self.log.t[-1] / 2)]
        return float("inf") if self.log.terminated else float(late.max())

    @property
    def settle_s(self) -> float:
        """Time after which the error stays below 5 cm [s]; infinite if it does not."""
        outside = np.flatnonzero(self.error >= SETTLED)
        if self.log.terminated or (len(outside) and outside[-1] == len(self.error) - 1):
            return float("inf")
        return float(self.log.t[outside[-1] + 1]) if len(outside) else 0.0

    @property
    def cross_track(self) -> float | None:
        """Mean cross-track error over the last seconds [m]; None for a task without one."""
        return None if self.cross is None else self._last(self.cross)

    @property
    def swaps(self) -> tuple[float, ...]:
        """Times at which a new policy took over [s]."""
        return tuple(e.t for e in self.log.events if e.kind == "policy")

    @property
    def events(self) -> tuple[Event, ...]:
        """What adaptation did."""
        return self.log.events

    def _last(self, error: np.ndarray) -> float:
        late = self.log.t > self.log.t[-1] - self.steady_seconds + 0.5 * self.log.dt  # by time: a tick may be missed
        return float("nan") if self.log.terminated else float(error[late].mean())


def fly_one(
    setup: Setup,
    policy: Policy | LoraPolicy,
    spec: FlightSpec,
    x0: State,
    seconds: float,
    *,
    latency: Latency = "fixed",
    state: LearnerState | None = None,
    observers: tuple[Observer, ...] = (),
    stop: Any = None,
) -> Flight:
    """Fly one flight.

    Args:
        setup: Preset of the policy, on the scenario's reference.
        policy: What flies.
        spec: Scenario, method and seeds.
        x0: State at the start.
        seconds: Length of the flight.
        latency: What learning costs in flight time.
        state: What an earlier flight learnt, to go on from.
        observers: They follow the flight.
        stop: A ``threading.Event`` that gives the flight up.

    Raises:
        PlantError: The plant refused.
        FlightStopped: ``stop`` was set.
    """
    preset, task = setup.preset, setup.flown
    pilot = setup.pilot(policy, spec.method, spec.key(), latency=latency, state=state)
    plant = spec.scenario.make(preset.vehicle, dt=preset.dt, seed=spec.plant_seed)

    def terminated(t: float, x: State) -> bool:
        return bool(_terminated(task, np.float64(t), x))

    log = fly(plant, pilot, x0, ticks=round(seconds / preset.dt), terminated=terminated, observers=observers, stop=stop)
    error, cross = _errors(task, log.t, log.true.as_state())
    return Flight(
        spec,
        spec.scenario.vehicle_name(preset.vehicle),
        log,
        np.asarray(error),
        task.metric,
        task.steady_seconds,
        None if cross is None else np.asarray(cross),
        pilot.state if isinstance(pilot, AdaptivePilot) else None,
    )


@eqx.filter_jit
def _terminated(task: AbstractTask, t: Any, x: State) -> Array:
    return task.terminated(jnp.asarray(t, dtype=x.p.dtype), x) | (x.p[2] < FLOOR)


@eqx.filter_jit
def _errors(task: AbstractTask, t: Any, x: State) -> tuple[Array, Array | None]:
    times = jnp.asarray(t, dtype=x.p.dtype)
    error = jax.vmap(task.error)(times, x)
    first = jax.eval_shape(task.cross_track, jax.tree.map(lambda leaf: leaf[0], x))
    return error, None if first is None else lax.map(task.cross_track, x)
