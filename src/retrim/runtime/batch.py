"""A flight of a simulated plant as one program, and many of them in step: one vehicle in the code, mapped over all."""

import threading
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Int

from ..control.controller import AbstractController
from ..learn.window import Window
from ..physics.state import Command, State, where
from ..plants.sim import SimState, Simulation
from .events import Event
from .flight import FlightStopped, Log, States

T = TypeVar("T")


class InFlight(eqx.Module):
    """Everything that a flight remembers between two ticks."""

    sim: SimState
    memory: Any
    """Of the controller."""
    tick: Int[Array, ""]
    """Ticks flown."""


class Ticks(eqx.Module):
    """What was flown, with a leading time axis: one row per tick."""

    true: State
    """True state at the end of the tick."""
    measured: State
    """Measured state at the end of the tick."""
    issued: Command
    """Command of the controller."""
    accepted: Command
    """Command that the plant accepted for the tick."""


def take_off(simulation: Simulation, controller: AbstractController[Any], x0: State) -> InFlight:
    """Return a flight that begins at ``x0``."""
    sim = simulation.launch(x0)
    return InFlight(sim, controller.init(simulation.measured(sim)), jnp.array(0))


def fly_ticks(
    simulation: Simulation, controller: AbstractController[Any], flight: InFlight, ticks: int
) -> tuple[InFlight, Ticks]:
    """Fly one vehicle on for some ticks; the controller may be another one, with the same memory, than before.

    The physics is the same, tick for tick, as flying :class:`retrim.SimPlant` with a
    :class:`retrim.ControllerPilot`. A flight never terminates.

    Args:
        simulation: What flies.
        controller: What decides.
        flight: The flight so far.
        ticks: How far to go on.

    Returns:
        The flight, and what was flown.
    """

    def tick(flight: InFlight, _: None) -> tuple[InFlight, Ticks]:
        s, k = flight.sim, flight.tick
        issued, memory = controller(flight.memory, s.t, simulation.measured(s))
        accepted = simulation.within_limits(issued)
        limited = jnp.any(accepted.vector() != issued.vector())
        memory = where(limited, controller.accepted(memory, accepted), memory)
        s = simulation.advance(s, accepted, k)
        return InFlight(s, memory, k + 1), Ticks(simulation.true(s), simulation.measured(s), issued, accepted)

    return lax.scan(tick, flight, length=ticks)


def batch_flight(simulation: Simulation, controller: AbstractController[Any], x0: State, *, ticks: int) -> Ticks:
    """Fly one vehicle from its start; ``jax.vmap`` or ``lax.map`` this over vehicles, starts or policies.

    Args:
        simulation: What flies; a :class:`retrim.SimPlant` has one.
        controller: What decides.
        x0: State at the start.
        ticks: Length of the flight.
    """
    return fly_ticks(simulation, controller, take_off(simulation, controller, x0), ticks)[1]


class Batch:
    """Flights in the air, and what they have left so far. Every array has a leading axis of flights."""

    def __init__(
        self,
        simulations: Simulation,
        starts: State,
        ticks: int,
        dt: float,
        progress: Callable[[float], None],
        stop: threading.Event | None,
    ) -> None:
        self.ticks, self.dt = ticks, dt
        self.controllers: Any = None
        """They fly; the next one takes over the memory of the last."""
        self.chunk = ticks
        """Ticks of one program."""
        self._simulations, self._starts, self._progress, self._stop = simulations, starts, progress, stop
        self._flights: InFlight | None = None
        self._flown = 0
        self._measured: Any = None  # from the start on
        self._rows: Any = None

    def fly_to(self, tick: int) -> None:
        """Fly on, in whole chunks, until so many ticks are flown.

        Raises:
            FlightStopped: The flights were given up.
        """
        while self._flown < tick:
            if self._stop is not None and self._stop.is_set():
                raise FlightStopped("the flights were given up")
            if self._flights is None:
                self._flights, first = _take_off(self._simulations, self.controllers, self._starts)
                self._measured = _recorded(None, jax.tree.map(lambda leaf: leaf[:, None], first), 0, self.ticks + 1)
            n = min(self.chunk, self.ticks - self._flown)
            self._flights, rows = _fly_on(self._simulations, self.controllers, self._flights, n)
            self._measured = _recorded(self._measured, rows.measured, self._flown + 1, self.ticks + 1)
            self._rows = _recorded(self._rows, rows, self._flown, self.ticks)
            self._flown += n
            self._progress(self._flown / self.ticks)

    def blank_window(self, size: int) -> Window:
        """Return windows of the shapes of a flight, of vehicles that hover where they start."""
        n = self._starts.p.shape[0]
        repeated = lambda leaf: jnp.asarray(np.repeat(np.asarray(leaf)[:, None], size, axis=1))  # noqa: E731
        hover = np.broadcast_to(np.asarray(Command.hover().vector()), (n, 4)).astype(self._starts.p.dtype)
        u = jax.tree.map(repeated, jax.vmap(Command.of)(jnp.asarray(hover)))
        t = jnp.asarray(np.broadcast_to(np.arange(size) * self.dt, (n, size)), dtype=self._starts.p.dtype)
        blank: Window = jax.vmap(Window)(t, jax.tree.map(repeated, self._starts), u, jnp.ones((n, size), dtype=bool))
        return blank

    def window(self, tick: int, size: int) -> Window:
        """Return the windows that learners are offered at ``tick``; it has been flown."""
        wanted = np.arange(tick - size + 1, tick + 1)
        at = np.maximum(wanted, 0)
        x = jax.tree.map(lambda leaf: jnp.asarray(leaf[:, at]), self._measured)
        # The plant has not accepted the newest command yet.
        newest = lambda old, new: jnp.asarray(np.concatenate([old[:, at[:-1]], new[:, at[-1:]]], axis=1))  # noqa: E731
        u = jax.tree.map(newest, self._rows.accepted, self._rows.issued)
        n = x.p.shape[0]
        t = jnp.asarray(np.broadcast_to(at * self.dt, (n, size)), dtype=x.p.dtype)
        windows: Window = jax.vmap(Window)(t, x, u, jnp.asarray(np.broadcast_to(wanted >= 0, (n, size))))
        return windows

    def log(self, i: int, events: Sequence[Event]) -> Log:
        """Return the log of one flight."""
        first, rows, measured = jax.tree.map(
            lambda leaf: np.asarray(leaf)[i], (self._starts, self._rows, self._measured)
        )
        accepted = rows.accepted
        names = ("p", "R", "v")
        true = (np.concatenate([getattr(first, name)[None], getattr(rows.true, name)]) for name in names)
        u = np.concatenate([accepted.c[:, None], accepted.omega], axis=1)
        hover = np.asarray(Command.hover().vector(), dtype=u.dtype)[None]
        t = np.arange(self.ticks + 1) * self.dt
        return Log(
            t,
            States(*true),
            States(*(getattr(measured, name) for name in names)),
            np.concatenate([hover, u]),
            self.dt,
            False,
            tuple(events),
        )


def stacked(trees: Sequence[T]) -> T:
    """Return trees of one structure as one, with a leading axis."""
    arrays = [eqx.filter(tree, eqx.is_array) for tree in trees]
    together = jax.tree.map(lambda *leaves: _stack(leaves), *arrays)
    whole: T = eqx.combine(together, eqx.filter(trees[0], eqx.is_array, inverse=True))
    return whole


def one(tree: T, i: int) -> T:
    """Return one of :func:`stacked` trees."""
    found: T = jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf)[i]), tree)
    return found


def _stack(leaves: Sequence[Any]) -> Array:
    """Stack arrays, without a program to compile for every shape."""
    if jnp.issubdtype(leaves[0].dtype, jax.dtypes.prng_key):
        return jnp.stack(leaves)
    return jnp.asarray(np.stack([np.asarray(leaf) for leaf in leaves]))


def _recorded(record: Any, rows: Any, at: int, size: int) -> Any:
    """Write rows into a record of a whole flight, at a tick; the second axis is time."""
    if record is None:
        record = jax.tree.map(lambda leaf: np.empty((leaf.shape[0], size, *leaf.shape[2:]), leaf.dtype), rows)

    def write(whole: np.ndarray, part: Any) -> np.ndarray:
        whole[:, at : at + part.shape[1]] = part
        return whole

    return jax.tree.map(write, record, rows)


@eqx.filter_jit
def _take_off(simulations: Simulation, controllers: Any, starts: State) -> tuple[InFlight, State]:
    def begin(simulation: Simulation, controller: Any, x0: State) -> tuple[InFlight, State]:
        flight = take_off(simulation, controller, x0)
        return flight, simulation.measured(flight.sim)

    begun: tuple[InFlight, State] = eqx.filter_vmap(begin)(simulations, controllers, starts)
    return begun


@eqx.filter_jit
def _fly_on(simulations: Simulation, controllers: Any, flights: InFlight, ticks: int) -> tuple[InFlight, Ticks]:
    flown: tuple[InFlight, Ticks] = eqx.filter_vmap(lambda s, c, f: fly_ticks(s, c, f, ticks))(
        simulations, controllers, flights
    )
    return flown
