"""Base class of plants that wrap an external simulator: ticks, command delay, external effects and measurements."""

import abc
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..errors import PlantError
from ..physics.disturbance import Disturbance, effects_at
from ..physics.effects import ExternalEffects
from ..physics.state import STANDARD_GRAVITY, Command, State
from .plant import Measurement, Plant, as_numpy, check_command, limit_command

HOVER = np.array([STANDARD_GRAVITY, 0.0, 0.0, 0.0])


class Pose(NamedTuple):
    """A :class:`State` in NumPy, double precision."""

    p: np.ndarray
    """Position in the world frame [m]."""
    R: np.ndarray
    """Attitude, body to world."""
    v: np.ndarray
    """Velocity in the world frame [m/s]."""
    omega: np.ndarray
    """Body rates [rad/s]."""


class ExternalPlant(Plant, abc.ABC):
    """A simulator with its own steps and a delay of one tick: the command from one tick acts in the next.

    A subclass implements :meth:`_launch` and :meth:`_advance`. The disturbance is evaluated at ``instants`` evenly
    spaced times in each tick, with the state at the start of the tick. Commands are clipped to the ``limits`` of
    [c, omega].
    """

    def __init__(
        self, disturbance: Disturbance, dt: float, *, limits: tuple[np.ndarray, np.ndarray], instants: int = 1
    ) -> None:
        self.dt = dt
        self._limits = limits
        self._disturbance = disturbance
        self._instants = dt * np.arange(instants) / instants
        self._x: State | None = None
        self._v = np.zeros(3)
        self._last_command = HOVER
        self._ticks = 0

    @abc.abstractmethod
    def _launch(self, x: Pose) -> None:
        """Start in a steady hover at ``x``, without rotation."""

    @abc.abstractmethod
    def _advance(self, u: np.ndarray, effects: ExternalEffects) -> Pose:
        """Advance one tick under the command ``u`` = [c [m/s^2], body rates [rad/s]].

        The leaves of ``effects`` are NumPy arrays with the instants on the leading axis. If the
        simulator does not support an effect, an implementation raises ``PlantError`` before the first step.
        """

    def reset(self, x0: State | None) -> Measurement:
        """Start hovering at ``x0``, or 1 m above the ground if ``x0`` is None."""
        start = State.at(jnp.array([0.0, 0.0, 1.0])) if x0 is None else x0
        at_rest = jnp.zeros_like(start.p)
        pose = Pose(*(np.asarray(a, dtype=np.float64) for a in (start.p, start.R, start.v, at_rest)))
        self._launch(pose)
        self._x, self._v, self._last_command, self._ticks = start, pose.v, HOVER, 0
        return Measurement(0.0, start, at_rest, at_rest, truth=start)

    def step(self, u: Command) -> tuple[Measurement, Command]:
        """Advance the simulator by one tick."""
        name = type(self).__name__
        command = check_command(u, name)
        if self._x is None:
            raise PlantError(f"{name}: not flying; call reset first")
        times = self._ticks * self.dt + self._instants
        effects = jax.tree.map(np.asarray, effects_at(times, self._x, self._disturbance))
        if np.any(effects.moment != 0.0):
            raise PlantError(f"{name}: cannot carry an off-centre load; the plants bem and simple can")
        after = self._advance(self._last_command, effects)
        dtype = self._x.p.dtype
        acceleration = (after.v - self._v) / self.dt  # in double precision: a difference in single has few digits
        *state, omega, a = (jnp.asarray(value, dtype=dtype) for value in (*after, acceleration))
        self._x, self._v = State(*state), after.v
        accepted_command = limit_command(u, command, *self._limits)
        self._last_command = as_numpy(accepted_command).astype(np.float64)
        self._ticks += 1
        return Measurement(self._ticks * self.dt, self._x, omega, a, truth=self._x), accepted_command

    def disturb(self, disturbance: Disturbance) -> None:
        """Change the disturbance in flight; new parameters of the same kind do not cause recompilation."""
        self._disturbance = disturbance

    def stop(self) -> None:
        """Discard the flight state."""
        self._x = None


def thrust_limits(least: float, most: float) -> tuple[np.ndarray, np.ndarray]:
    """Return limits of [c, omega] from mass-normalised thrust limits [m/s^2]; body rates are unlimited."""
    free = np.full(3, np.inf)
    return np.append(least, -free), np.append(most, free)


def whole_steps(dt: float, step: float) -> int:
    """Return the number of simulator steps in a tick; raise ``ValueError`` if it is not a whole number (times in s)."""
    steps = round(dt / step)
    if steps < 1 or abs(dt / step - steps) > 1e-6:
        raise ValueError(f"a tick of {dt} s is not a multiple of the simulator's step, {step} s")
    return steps
