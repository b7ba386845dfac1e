"""The flight loop and the record that every flight leaves."""

import threading
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..errors import ConfigError, RetrimError
from ..learn.window import Window
from ..physics.state import Command, State
from ..plants.plant import Measurement, Plant, as_numpy
from .events import Event, Observer
from .pilot import Pilot


class FlightStopped(RetrimError):
    """A flight was given up because its stop token was set."""


class States(NamedTuple):
    """States of a flight as NumPy arrays with a leading time axis."""

    p: np.ndarray
    """World [m]."""
    R: np.ndarray
    """Body to world."""
    v: np.ndarray
    """World [m/s]."""

    def as_state(self) -> State:
        """Return the same as a :class:`State` of JAX arrays."""
        state: State = jax.vmap(State)(*map(jnp.asarray, self))
        return state


class Log(NamedTuple):
    """A flight as it was. Row 0 is the start; a flight of n ticks has n + 1 rows."""

    t: np.ndarray
    """Time since the start of the flight [s]."""
    true: States
    """True states, where the plant knows them; else the measured ones."""
    measured: States
    """What the pilot was shown."""
    u: np.ndarray
    """Command accepted for the tick that ended in each row: c [m/s^2], omega [rad/s]; hover in row 0."""
    dt: float
    """Control tick of the plant [s]."""
    terminated: bool
    """The vehicle left the task's bounds; the flight ended there."""
    events: tuple[Event, ...] = ()
    age: np.ndarray | float = 0.0
    """How old each row's measurement was [s]."""

    @property
    def p(self) -> np.ndarray:
        """True positions, world [m]."""
        return self.true.p

    @property
    def R(self) -> np.ndarray:
        """True attitudes, body to world."""
        return self.true.R

    @property
    def v(self) -> np.ndarray:
        """True velocities, world [m/s]."""
        return self.true.v

    @property
    def missed_ticks(self) -> int:
        """Ticks for which there is no measurement, by the plant's clock."""
        return int(np.sum(np.maximum(np.round(np.diff(self.t) / self.dt).astype(int) - 1, 0)))

    def window(self, ticks: int, *, end: int | None = None) -> Window:
        """Return what a learner saw: measured states, each with the command that *followed* it.

        Args:
            ticks: Length of the window.
            end: Row after its last one; by default the window ends with the flight.

        Raises:
            ValueError: The flight has no such rows.
        """
        last = len(self.t) - 1 if end is None else end
        if not 0 < ticks <= last < len(self.t):
            raise ValueError(f"Log.window: {ticks} ticks up to row {last} of a flight of {len(self.t) - 1} ticks")
        states = jax.tree.map(lambda leaf: leaf[last - ticks : last], self.measured.as_state())
        t = jnp.asarray(self.t[last - ticks : last], dtype=states.p.dtype)
        u = jax.vmap(Command.of)(jnp.asarray(self.u[last - ticks + 1 : last + 1], dtype=states.p.dtype))
        age = np.broadcast_to(self.age, self.t.shape)[last - ticks : last]
        return Window(t, states, u, jnp.ones(ticks, dtype=bool), jnp.asarray(age, dtype=states.p.dtype))


class Recorder:
    """An observer that keeps the whole flight."""

    def __init__(self) -> None:
        self._rows: list[tuple[float, State, State, Command, float]] = []
        self._events: list[Event] = []

    def measurement(self, measurement: Measurement, u: Command) -> None:
        """Keep a measurement, and the command accepted for the tick that it ended."""
        self._rows.append((measurement.t, measurement.true_state, measurement.x, u, measurement.age))

    def event(self, event: Event) -> None:
        """Keep an event."""
        self._events.append(event)

    def log(self, dt: float, *, terminated: bool) -> Log:
        """Return what was recorded."""
        times, true, measured, commands, ages = zip(*self._rows, strict=True)
        t = np.array(times)
        u = np.stack([as_numpy(command) for command in commands])
        return Log(t - t[0], _stacked(true), _stacked(measured), u, dt, terminated, tuple(self._events), np.array(ages))


def fly(
    plant: Plant,
    pilot: Pilot,
    x0: State | None = None,
    *,
    ticks: int,
    terminated: Callable[[float, State], bool] = lambda t, x: False,
    observers: Sequence[Observer] = (),
    stop: threading.Event | None = None,
) -> Log:
    """Fly a plant with a pilot. The plant is stopped whatever happens.

    Args:
        plant: What flies; its clock may start anywhere.
        pilot: What decides.
        x0: State in which the flight starts; None for where the vehicle is.
        ticks: Length of the flight in ticks of the plant's clock; a missed tick counts.
        terminated: Ends the flight early: a function of the time since its start [s] and of the true state.
        observers: Receive every measurement and event.
        stop: Set from another thread to give the flight up.

    Returns:
        The log, with one row more than ticks flown.

    Raises:
        ConfigError: Pilot and plant tick at different rates.
        PlantError: The plant refused a command or was lost.
        FlightStopped: ``stop`` was set.
    """
    if pilot.dt is not None and abs(pilot.dt - plant.dt) > 1e-9:
        raise ConfigError(
            f"the pilot was made for ticks of {pilot.dt:g} s, the plant has {plant.dt:g} s; pass dt to it"
        )
    recorder, ended = Recorder(), False
    everyone: tuple[Observer, ...] = (recorder, *observers)
    with plant:
        measurement = plant.reset(x0)
        start = measurement.t
        pilot.reset(measurement)
        _tell(everyone, measurement, Command.hover(), [])
        while round((measurement.t - start) / plant.dt) < ticks and not ended:
            if stop is not None and stop.is_set():
                raise FlightStopped("the flight was given up")
            u = pilot.act(measurement)
            measurement, accepted = plant.step(u)
            if accepted is not u:
                pilot.accepted(accepted)
            _tell(everyone, measurement, accepted, pilot.take_events())
            ended = terminated(measurement.t - start, measurement.true_state)
    return recorder.log(plant.dt, terminated=ended)


def _tell(observers: Sequence[Observer], measurement: Measurement, u: Command, events: Sequence[Event]) -> None:
    for observer in observers:
        for event in events:
            observer.event(event)
        observer.measurement(measurement, u)


def _stacked(states: Sequence[State]) -> States:
    return States(*(np.stack([np.asarray(getattr(x, name)) for x in states]) for name in ("p", "R", "v")))
