"""The flight loop and the record of a flight."""

import threading
from collections import Counter
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..errors import ConfigError, RetrimError
from ..learn.window import Window
from ..physics.state import Command, State
from ..plants.plant import Measurement, Plant, as_numpy
from ..progress import Progress, show_progress
from .events import Event, Observer
from .pilot import Pilot

if TYPE_CHECKING:
    from ..viz.flight_curves import Figure


class FlightStopped(RetrimError):
    """The flight was aborted because its stop token was set."""


class States(NamedTuple):
    """States of a flight as NumPy arrays with a leading time axis."""

    p: np.ndarray
    """Positions in the world frame [m]."""
    R: np.ndarray
    """Attitudes, body to world."""
    v: np.ndarray
    """Velocities in the world frame [m/s]."""

    def as_state(self) -> State:
        """Return the same states as a :class:`State` of JAX arrays."""
        state: State = jax.vmap(State)(*map(jnp.asarray, self))
        return state

    def __repr__(self) -> str:
        """Return the number of rows, and the first and the last position."""
        ends = f" from {_place(self.p[0])} to {_place(self.p[-1])} m" if len(self.p) else ""
        return f"States: {len(self.p)} rows{ends}"


class Log(NamedTuple):
    """Record of a flight. Row 0 is the start; a flight of n ticks has n + 1 rows."""

    t: np.ndarray
    """Time since the start of the flight [s]."""
    true: States
    """True states if the plant provides them; otherwise the measured ones."""
    measured: States
    """Measured states, which the pilot receives."""
    u: np.ndarray
    """Command accepted for the tick that ended in each row: c [m/s^2], omega [rad/s]; hover in row 0."""
    dt: float
    """Control tick of the plant [s]."""
    terminated: bool
    """True if the vehicle left the bounds of the task, which ended the flight."""
    events: tuple[Event, ...] = ()
    age: np.ndarray | float = 0.0
    """Age of the measurement in each row [s]."""
    phase: np.ndarray | None = None
    """Time along the reference in each row [s]; None if it is equal to ``t``."""

    @property
    def task_time(self) -> np.ndarray:
        """Time of the task in each row [s]: the phase of a paced reference, otherwise the flight time."""
        return self.t if self.phase is None else self.phase

    @property
    def p(self) -> np.ndarray:
        """True positions in the world frame [m]."""
        return self.true.p

    @property
    def R(self) -> np.ndarray:
        """True attitudes, body to world."""
        return self.true.R

    @property
    def v(self) -> np.ndarray:
        """True velocities in the world frame [m/s]."""
        return self.true.v

    @property
    def missed_ticks(self) -> int:
        """Number of ticks without a measurement, on the plant's clock."""
        return int(np.sum(np.maximum(np.round(np.diff(self.t) / self.dt).astype(int) - 1, 0)))

    def __repr__(self) -> str:
        """Return the duration, the ends of the path and the numbers of events, in a few lines."""
        kinds = Counter(event.kind for event in self.events)
        ending = "terminated" if self.terminated else "not terminated"
        return "\n".join(
            [
                f"Log: {self.t[-1]:.2f} s, {len(self.t) - 1} ticks of {1000 * self.dt:g} ms, "
                f"{self.missed_ticks} missed, {ending}",
                f"  position: from {_place(self.p[0])} to {_place(self.p[-1])} m",
                f"  events: {', '.join(f'{n} {kind}' for kind, n in kinds.items()) or 'none'}",
            ]
        )

    def plot(self, target: np.ndarray | Sequence[Any] | None = None) -> "Figure":
        """Draw the error with the policy updates, the path from above, and the commands.

        Args:
            target: Target position in the world frame [m], (3,) or (rows, 3); without it, the coordinates are drawn
                instead of the error.

        Returns:
            A matplotlib figure, which a notebook shows.
        """
        from ..viz.flight_curves import FlightCurves, curves_figure

        places = None if target is None else np.broadcast_to(np.asarray(target, dtype=float), self.p.shape)
        error = None if places is None else np.linalg.norm(self.p - places, axis=1)
        updates = tuple(event.t for event in self.events if event.kind == "policy")
        curves = FlightCurves("flight", self.t, self.p, self.u, error, places, updates, self.terminated)
        return curves_figure(f"Flight of {self.t[-1]:.2f} s", [curves])

    def window(self, ticks: int, *, end: int | None = None) -> Window:
        """Return a learner's input: measured states, each with the command that *followed* it.

        Args:
            ticks: Length of the window.
            end: Row after the last row of the window; by default the window ends with the flight.

        Raises:
            ValueError: The flight does not contain these rows.
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
    """An observer that records the whole flight."""

    def __init__(self) -> None:
        self._rows: list[tuple[float, State, State, Command, float]] = []
        self._events: list[Event] = []

    def measurement(self, measurement: Measurement, u: Command) -> None:
        """Keep a measurement, and the command accepted for the tick that it ends."""
        self._rows.append((measurement.t, measurement.true_state, measurement.x, u, measurement.age))

    def event(self, event: Event) -> None:
        """Keep an event."""
        self._events.append(event)

    def log(self, dt: float, phase: Sequence[float], *, terminated: bool) -> Log:
        """Return the recorded flight.

        Args:
            dt: Control tick [s].
            phase: Time along the reference in each row [s].
            terminated: Whether the vehicle left the bounds of the task, or received a command that is not finite.
        """
        times, true, measurement, commands, ages = zip(*self._rows, strict=True)
        t = np.array(times)
        u = np.stack([as_numpy(command) for command in commands])
        t, phases = t - t[0], np.array(phase)
        return Log(
            t, _stack(true), _stack(measurement), u, dt, terminated, tuple(self._events), np.array(ages),
            None if np.array_equal(phases, t) else phases,
        )  # fmt: skip


def fly(
    plant: Plant,
    pilot: Pilot,
    x0: State | None = None,
    *,
    ticks: int,
    terminated: Callable[[float, State], bool] = lambda t, x: False,
    observers: Sequence[Observer] = (),
    stop: threading.Event | None = None,
    progress: Progress = show_progress,
) -> Log:
    """Fly a plant with a pilot. The plant is always stopped at the end, even after an error.

    Args:
        plant: The vehicle to fly; its clock may start at any time.
        pilot: Source of the commands.
        x0: State at the start of the flight; None for the vehicle's present state.
        ticks: Length of the flight in ticks of the plant's clock; a missed tick counts.
        terminated: Function of the time along the reference [s], which is usually the time since the start, and the
            true state. It returns whether to end the flight early.
        observers: Observers, which receive every measurement and event.
        stop: Event that aborts the flight; set it from another thread.
        progress: Display of the progress; by default a bar in a notebook or a terminal, and nothing elsewhere.

    Returns:
        The log, with one more row than ticks. A command that is not finite ends the flight like a crash.

    Raises:
        ConfigError: Pilot and plant have different control periods.
        PlantError: The plant refused a command or was lost.
        FlightStopped: ``stop`` was set.
    """
    if pilot.dt is not None and abs(pilot.dt - plant.dt) > 1e-9:
        raise ConfigError(
            f"the pilot was made for ticks of {pilot.dt:g} s, the plant has {plant.dt:g} s; pass dt to it"
        )
    recorder, phase, is_over = Recorder(), [0.0], False
    everyone: tuple[Observer, ...] = (recorder, *observers)
    with plant, progress("flying") as advance:
        advance(0.0, "compiling")
        measurement = plant.reset(x0)
        start = measurement.t
        pilot.reset(measurement)
        _tell(everyone, measurement, Command.hover(), [])
        while round((measurement.t - start) / plant.dt) < ticks and not is_over:
            if stop is not None and stop.is_set():
                raise FlightStopped("the flight was aborted")
            u = pilot.act(measurement)
            if not np.isfinite(as_numpy(u)).all():
                is_over = True
                t = measurement.t - start
                for observer in everyone:
                    observer.event(Event(t, "terminated", f"the command {as_numpy(u).tolist()} is not finite"))
                break
            measurement, accepted_command = plant.step(u)
            if accepted_command is not u:
                pilot.accept(accepted_command)
            _tell(everyone, measurement, accepted_command, pilot.take_events())
            t = measurement.t - start
            phase.append(pilot.task_time(t))
            is_over = terminated(phase[-1], measurement.true_state)
            advance(min(1.0, t / (ticks * plant.dt)), f"{t:.1f} of {ticks * plant.dt:g} s")
    return recorder.log(plant.dt, phase, terminated=is_over)


def _tell(observers: Sequence[Observer], measurement: Measurement, u: Command, events: Sequence[Event]) -> None:
    for observer in observers:
        for event in events:
            observer.event(event)
        observer.measurement(measurement, u)


def _stack(states: Sequence[State]) -> States:
    return States(*(np.stack([np.asarray(getattr(x, name)) for x in states]) for name in ("p", "R", "v")))


def _place(p: np.ndarray) -> str:
    """Return a position as rounded numbers."""
    return "[" + ", ".join(f"{value:z.3f}" for value in p.tolist()) + "]"
