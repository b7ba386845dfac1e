"""The one imperative seam: whatever moves. Simulators, other engines and vehicles stand behind the same three calls."""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..control.controller import AbstractController
from ..learn.residual import Window
from ..physics.state import Command, State
from .sink import Sink


class PlantError(RuntimeError):
    """A plant refused what it was asked, or is gone. The message names what was wrong."""


class Sample(NamedTuple):
    """What a plant measured at the end of a tick."""

    t: float
    """Since the reset [s]."""
    x: State
    u: Command
    """Command issued for the tick that ended in ``x``; hover at the reset."""
    a: Float[Array, "3"] | None = None
    """Measured acceleration, world [m/s^2], if the plant has one."""
    truth: State | None = None
    """What the state really was, where the plant knows better than its sensors. For scores, never for pilots."""

    @property
    def really(self) -> State:
        """``truth``, or the measured state where that is all there is."""
        return self.x if self.truth is None else self.truth


@runtime_checkable
class Plant(Protocol):
    """Three calls. ``stop`` is idempotent, leaves the vehicle safe, and is always called at the end of a flight."""

    dt: float
    """Tick [s]."""

    def reset(self, x0: State | None) -> Sample:
        """Start anew, at ``x0`` or where the vehicle is; raises ``PlantError`` if it cannot."""
        ...

    def exchange(self, u: Command) -> Sample:
        """Apply ``u`` for one tick, block, return what was measured.

        Raises ``PlantError`` for a command that is not finite, before it reaches the vehicle, and after ``stop``.
        """
        ...

    def stop(self) -> None:
        """Safe state."""
        ...


def numbers(u: Command) -> np.ndarray:
    """[c, omega] in NumPy; unlike ``u.vector()`` not an operation of JAX, of which a tick should have few."""
    return np.append(np.asarray(u.c), np.asarray(u.omega))


def refuse_unsound(u: Command, plant: str) -> None:
    """Raise ``PlantError``, naming the entry, if a command is not finite; every plant calls it first."""
    for name, value in zip(("c", "omega[0]", "omega[1]", "omega[2]"), numbers(u).tolist(), strict=True):
        if not math.isfinite(value):
            raise PlantError(f"{plant}: command refused, {name} = {value} is not finite")


Pilot = Callable[[Sample], Command]
"""Decides the next command from the last sample; may hold whatever it needs to."""


class ControllerPilot:
    """Any controller as a pilot: it keeps the controller's memory."""

    def __init__(self, controller: AbstractController[Any]) -> None:
        self.controller = controller
        self._memory: Any = None

    def __call__(self, sample: Sample) -> Command:
        """One call of the controller; a sample at time zero starts its memory anew."""
        if sample.t == 0.0 or self._memory is None:
            self._memory = self.controller.init(sample.x)
        u, self._memory = _decide(
            self.controller, self._memory, jnp.asarray(sample.t, dtype=sample.x.p.dtype), sample.x
        )
        return u


@eqx.filter_jit
def _decide(controller: AbstractController[Any], memory: Any, t: Float[Array, ""], x: State) -> tuple[Command, Any]:
    return controller(memory, t, x)


class Log(NamedTuple):
    """A flight as it was: NumPy arrays, ticks in front. States are the true ones, where the plant tells them."""

    t: np.ndarray
    """[s]"""
    p: np.ndarray
    """World [m]."""
    R: np.ndarray
    """Body to world."""
    v: np.ndarray
    """World [m/s]."""
    u: np.ndarray
    """Commands issued for the ticks that ended in these states: c [m/s^2], omega [rad/s]."""
    crashed: bool
    """The vehicle left the task's bounds; the flight ended there."""

    @property
    def x(self) -> State:
        """The states, ticks in front."""
        states: State = jax.vmap(State)(*map(jnp.asarray, (self.p, self.R, self.v)))
        return states

    def window(self, ticks: int) -> Window:
        """The last ticks as a learner takes them: each state with the command that *followed* it.

        Raises ``ValueError`` for a flight that was shorter.
        """
        if not 0 < ticks < len(self.t):
            raise ValueError(f"Log.window: {ticks} ticks of a flight of {len(self.t) - 1}")
        states = jax.tree.map(lambda leaf: leaf[-ticks - 1 : -1], self.x)
        t = jnp.asarray(self.t[-ticks - 1 : -1], dtype=states.p.dtype)
        u = jax.vmap(Command.of)(jnp.asarray(self.u[-ticks:], dtype=states.p.dtype))
        return Window(t, states, u, jnp.ones(ticks, dtype=bool))


def fly(
    plant: Plant,
    pilot: Pilot,
    x0: State | None,
    *,
    ticks: int,
    alive: Callable[[Sample], bool] = lambda sample: True,
    sinks: Sequence[Sink] = (),
) -> Log:
    """Fly ``ticks`` ticks, or until ``alive`` says no. The plant is stopped whatever happens."""
    samples: list[Sample] = []
    crashed = False
    try:
        sample = plant.reset(x0)
        samples.append(sample)
        for _ in range(ticks):
            sample = plant.exchange(pilot(sample))
            samples.append(sample)
            for sink in sinks:
                sink.state(sample)
            if not alive(sample):
                crashed = True
                break
    finally:
        plant.stop()
    return Log(
        np.array([s.t for s in samples]),
        np.stack([np.asarray(s.really.p) for s in samples]),
        np.stack([np.asarray(s.really.R) for s in samples]),
        np.stack([np.asarray(s.really.v) for s in samples]),
        np.stack([numbers(s.u) for s in samples]),
        crashed,
    )
