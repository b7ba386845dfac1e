"""Advance flights in step, as arrays with a leading axis of flights, and record them."""

import threading
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..learn.devices import shard
from ..learn.stacking import stack
from ..learn.window import Window
from ..physics.state import Command, State
from ..plants.sim import SimState, Simulation
from ..tasks.paced_reference import Clock
from .batch import InFlight, Ticks, fly_ticks, in_flight
from .events import Event, stage_events, vehicle_events
from .flight import FlightStopped, Log, States

ROOM = 50  # ticks per call; the period of progress reports and stop checks


class Batch:
    """Flights in progress, and their record so far. Every array has a leading axis of flights."""

    def __init__(
        self,
        simulations: Sequence[Simulation],
        starts: Sequence[State],
        ticks: int,
        dt: float,
        progress: Callable[[float], None],
        stop: threading.Event | None,
    ) -> None:
        self.ticks, self.dt = ticks, dt
        self.controllers: Any = None
        """Controllers of the flights; new ones take over the memory of the previous ones."""
        self._simulations, self._starts = stack(simulations), stack(starts)
        self._progress, self._stop = progress, stop
        # Without disturbances, plants of one kind have the same structure, so one program launches all of them.
        self._on_the_ground = stack([simulation.without_disturbances() for simulation in simulations])
        self._flights: InFlight | None = None
        self._tick_count = 0
        self._measurement: Any = None  # from the start on
        self._rows: Any = None

    def fly_to(self, tick: int) -> None:
        """Continue the flights up to a tick.

        Raises:
            FlightStopped: The flights were aborted.
        """
        while self._tick_count < tick:
            if self._stop is not None and self._stop.is_set():
                raise FlightStopped("the flights were aborted")
            if self._flights is None:
                sims, first = _launch(self._on_the_ground, self._starts)
                self._flights = _begin(self.controllers, sims, first)
                self._measurement = _record(None, first, 0, self.ticks + 1, rows=1)
            n = min(ROOM, tick - self._tick_count)
            self._flights, rows = _fly_on(self._simulations, self.controllers, self._flights, jnp.asarray(n))
            self._measurement = _record(self._measurement, rows.measured, self._tick_count + 1, self.ticks + 1, rows=n)
            self._rows = _record(self._rows, rows, self._tick_count, self.ticks, rows=n)
            self._tick_count += n
            self._progress(self._tick_count / self.ticks)

    def blank_window(self, size: int) -> Window:
        """Return windows shaped like those of a flight, for vehicles that hover at their starts."""
        n = self._starts.p.shape[0]
        x = jax.tree.map(lambda leaf: jax.device_put(np.repeat(np.asarray(leaf)[:, None], size, axis=1)), self._starts)
        hover = Command.hover(x.p.dtype)
        u = jax.tree.map(lambda leaf: jax.device_put(np.broadcast_to(leaf, (n, size, *leaf.shape))), hover)
        nothing, every = jnp.zeros((n, size), x.p.dtype), jnp.ones((n, size), dtype=bool)
        blank: Window = shard(jax.vmap(Window)(nothing, x, u, every, nothing))
        return blank

    def window(self, tick: int, size: int) -> Window:
        """Return the windows that learners are offered at ``tick``, which the flights must have passed."""
        window_ticks = np.arange(tick - size + 1, tick + 1)
        at = np.maximum(window_ticks, 0)
        x = jax.tree.map(lambda leaf: jax.device_put(leaf[:, at]), self._measurement)
        # The plant has not accepted the newest command yet.
        newest = lambda old, new: jax.device_put(np.concatenate([old[:, at[:-1]], new[:, at[-1:]]], axis=1))  # noqa: E731
        u = jax.tree.map(newest, self._rows.accepted, self._rows.issued)
        n = x.p.shape[0]
        t = jnp.asarray(np.broadcast_to(at * self.dt, (n, size)), dtype=x.p.dtype)
        valid, age = (
            jax.device_put(np.broadcast_to(window_ticks >= 0, (n, size))),
            jnp.full_like(t, self._simulations.age),
        )
        windows: Window = shard(jax.vmap(Window)(t, x, u, valid, age))
        return windows

    def log(self, i: int, events: Sequence[Event]) -> Log:
        """Return the log of one flight."""
        first, rows, measurement = jax.tree.map(
            lambda leaf: np.asarray(leaf)[i], (self._starts, self._rows, self._measurement)
        )
        accepted_commands = rows.accepted
        names = ("p", "R", "v")
        true = (np.concatenate([getattr(first, name)[None], getattr(rows.true, name)]) for name in names)
        u = np.concatenate([accepted_commands.c[:, None], accepted_commands.omega], axis=1)
        hover = np.asarray(Command.hover().vector(), dtype=u.dtype)[None]
        t = np.arange(self.ticks + 1) * self.dt
        own = [*stage_events(rows.condition, t[:-1]), *vehicle_events(rows.vehicle, t[:-1])]
        events = sorted([*events, *own], key=lambda event: event.t)
        return Log(
            t,
            States(*true),
            States(*(getattr(measurement, name) for name in names)),
            np.concatenate([hover, u]),
            self.dt,
            False,
            tuple(events),
            self._simulations.age,
            None if rows.clock is None else _phases(rows.clock, t),
        )


def _record(record: Any, new: Any, at: int, size: int, *, rows: int) -> Any:
    """Write the first rows of ``new`` into a record of the flight, from tick ``at`` on; the second axis is time."""
    if record is None:
        record = jax.tree.map(lambda leaf: np.empty((leaf.shape[0], size, *leaf.shape[2:]), leaf.dtype), new)

    def write(whole: np.ndarray, part: Any) -> np.ndarray:
        whole[:, at : at + rows] = np.asarray(part)[:, :rows]
        return whole

    return jax.tree.map(write, record, new)


def _phases(clocks: Clock, t: np.ndarray) -> np.ndarray:
    """Return the phase at each row of a log from the clock of each tick."""
    last: Clock = jax.tree.map(lambda leaf: jnp.asarray(leaf[-1]), clocks)
    return np.append(clocks.phase, float(last.phase_at(jnp.asarray(t[-1], last.t.dtype)))).astype(float)


@eqx.filter_jit
def _launch(simulations: Simulation, starts: State) -> tuple[SimState, State]:
    def launch(simulation: Simulation, x0: State) -> tuple[SimState, State]:
        sim = simulation.launch(x0)
        return sim, jax.tree.map(lambda leaf: leaf[None], simulation.measure(sim))

    start: tuple[SimState, State] = eqx.filter_vmap(launch)(simulations, starts)
    return start


@eqx.filter_jit
def _begin(controllers: Any, sims: SimState, measurement: State) -> InFlight:
    first = jax.tree.map(lambda leaf: leaf[:, 0], measurement)
    flights: InFlight = eqx.filter_vmap(in_flight)(controllers, sims, first)
    return flights


@eqx.filter_jit
def _fly_on(simulations: Simulation, controllers: Any, flights: InFlight, ticks: Array) -> tuple[InFlight, Ticks]:
    result: tuple[InFlight, Ticks] = eqx.filter_vmap(lambda s, c, f: fly_ticks(s, c, f, ticks, room=ROOM))(
        simulations, controllers, flights
    )
    return result
