"""Base class of plants that wrap another simulator: tick, command delay, external effects, measurements."""

import abc
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..errors import PlantError
from ..physics.disturbance import Disturbance, effects_at
from ..physics.effects import ExternalEffects
from ..physics.state import STANDARD_GRAVITY, Command, State
from .plant import Measurement, Plant, check_command

HOVER = np.array([STANDARD_GRAVITY, 0.0, 0.0, 0.0])


class Pose(NamedTuple):
    """A :class:`State` in NumPy, double precision."""

    p: np.ndarray
    """World [m]."""
    R: np.ndarray
    """Body to world."""
    v: np.ndarray
    """World [m/s]."""


class ExternalPlant(Plant, abc.ABC):
    """A simulator that steps on its own, one command late: the command of a tick acts in the next one.

    A simulator gives :meth:`_launch` and :meth:`_advance`. The disturbance is evaluated at ``instants`` evenly spaced
    times of each tick, in the state at its beginning.
    """

    def __init__(self, disturbance: Disturbance, dt: float, *, instants: int = 1) -> None:
        self.dt = dt
        self._disturbance = disturbance
        self._instants = dt * np.arange(instants) / instants
        self._x: State | None = None
        self._held = HOVER
        self._ticks = 0

    @abc.abstractmethod
    def _launch(self, x: Pose) -> None:
        """Hovering at ``x``, as if it had done so for long; without rotation."""

    @abc.abstractmethod
    def _advance(self, u: np.ndarray, effects: ExternalEffects) -> Pose:
        """One tick under ``u`` = [c [m/s^2], body rates [rad/s]]; leaves of ``around`` are NumPy, instants in front.

        Raises ``PlantError``, before anything moves, for conditions that the simulator does not know.
        """

    def reset(self, x0: State | None) -> Measurement:
        """Hover at ``x0``; without one, 1 m above the ground."""
        start = State.at(jnp.array([0.0, 0.0, 1.0])) if x0 is None else x0
        self._launch(Pose(*(np.asarray(a, dtype=np.float64) for a in (start.p, start.R, start.v))))
        self._x, self._held, self._ticks = start, HOVER, 0
        return Measurement(0.0, start, truth=start)

    def step(self, u: Command) -> tuple[Measurement, Command]:
        """Advance the simulator by one tick."""
        name = type(self).__name__
        wanted = check_command(u, name)
        if self._x is None:
            raise PlantError(f"{name}: not flying; call reset first")
        times = self._ticks * self.dt + self._instants
        effects = jax.tree.map(np.asarray, effects_at(times, self._x, self._disturbance))
        after = self._advance(self._held, effects)
        dtype = self._x.p.dtype
        self._x = State(*(jnp.asarray(a, dtype=dtype) for a in after))
        self._held = wanted.astype(np.float64)
        self._ticks += 1
        return Measurement(self._ticks * self.dt, self._x, truth=self._x), u

    def disturb(self, disturbance: Disturbance) -> None:
        """Fly on under another disturbance; one of the same kind with other numbers compiles nothing."""
        self._disturbance = disturbance

    def stop(self) -> None:
        """Forget the flight."""
        self._x = None


def whole_steps(dt: float, step: float) -> int:
    """Steps of the simulator in a tick; raises ``ValueError`` if they do not fill it [s]."""
    steps = round(dt / step)
    if steps < 1 or abs(dt / step - steps) > 1e-6:
        raise ValueError(f"a tick of {dt} s is no multiple of the simulator's step, {step} s")
    return steps
