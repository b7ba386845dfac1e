"""Faults of a measurement system: measured states that are wrong, late, repeated or missing.

A fault is a pure function of the last few measurements and the number of the newest one, so a flight is reproducible.
Faults are not announced: a measurement's age and validity remain as in the sensor model.
"""

import abc
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import random
from jaxtyping import Array, Float, Int, Key

from ..physics import so3
from ..physics.state import State, where


class AbstractMeasurementFault(eqx.Module):
    """Mapping from correct measurements to the reports of a faulty measurement system."""

    interrupts: ClassVar[bool] = False
    """Whether measurements are missing or have wrong times; flights with such a fault are simulated one by one."""

    @property
    def memory(self) -> int:
        """Number of earlier measurements that the fault needs."""
        return 0

    @abc.abstractmethod
    def __call__(self, past: State, tick: Int[Array, ""], key: Key[Array, ""]) -> State:
        """Return the reported state.

        Args:
            past: Correct measurements, oldest first (leading axis ``memory`` + 1); the last one is due now.
            tick: Number of the measurement, counted from the start of the flight.
            key: Seed of this measurement; consumed.
        """

    def is_missing(self, tick: int) -> bool:
        """Return whether the measurement at a tick is missing."""
        del tick
        return False

    def clock_error(self, tick: int) -> float:
        """Return the error of a measurement's time [s]."""
        del tick
        return 0.0


class WrongState(AbstractMeasurementFault):
    """A single state is periodically wrong, as happens when a motion-capture system confuses the markers of a body."""

    p: Float[Array, "3"]
    """Shift in the world frame [m]."""
    rotation: Float[Array, "3"]
    """Rotation vector in the body frame [rad]."""
    v: Float[Array, "3"]
    """Velocity error in the world frame [m/s]."""
    every: Int[Array, ""]
    """Period [ticks]; with 1, every state is wrong."""

    def __call__(self, past: State, tick: Int[Array, ""], key: Key[Array, ""]) -> State:
        """Add the errors to the last state in each period of ``every`` ticks."""
        x = _newest(past)
        now = (tick % self.every == self.every - 1).astype(x.p.dtype)
        p, rotation, v = (now * error.astype(x.p.dtype) for error in (self.p, self.rotation, self.v))
        return State(x.p + p, so3.mul(x.R, so3.exp(rotation)), x.v + v)


class Late(AbstractMeasurementFault):
    """Every measurement is older than its declared age."""

    ticks: int = eqx.field(static=True)

    @property
    def memory(self) -> int:
        """Number of earlier measurements that the fault needs."""
        return self.ticks

    def __call__(self, past: State, tick: Int[Array, ""], key: Key[Array, ""]) -> State:
        """Return the oldest measurement."""
        return jax.tree.map(lambda leaf: leaf[0], past)  # type: ignore[no-any-return]


class Frozen(AbstractMeasurementFault):
    """The measurement system stops periodically and repeats its last state with new times."""

    every: Int[Array, ""]
    """Time between two stops [ticks]."""
    duration: int = eqx.field(static=True)
    """Length of a stop [ticks]."""

    @property
    def memory(self) -> int:
        """Number of earlier measurements that the fault needs."""
        return self.duration

    def __call__(self, past: State, tick: Int[Array, ""], key: Key[Array, ""]) -> State:
        """Return the state at the tick before the current stop, or the newest state if there is no stop."""
        since = tick % self.every
        frozen = (tick >= self.every) & (since < self.duration)
        row = self.duration - jnp.where(frozen, since + 1, 0)
        return jax.tree.map(lambda leaf: leaf[row], past)  # type: ignore[no-any-return]


class Repeated(AbstractMeasurementFault):
    """Each measurement is lost with a given probability; the previous measurement is then reported again."""

    probability: Float[Array, ""]

    @property
    def memory(self) -> int:
        """Number of earlier measurements that the fault needs."""
        return 1

    def __call__(self, past: State, tick: Int[Array, ""], key: Key[Array, ""]) -> State:
        """Return the newest measurement or the one before it."""
        is_lost = random.uniform(key, (), self.probability.dtype) < self.probability
        before, now = (jax.tree.map(lambda leaf, row=row: leaf[row], past) for row in (0, 1))
        result: State = where(is_lost, before, now)
        return result


class ScaledVelocity(AbstractMeasurementFault):
    """Velocities have a wrong scale."""

    scale: Float[Array, ""]

    def __call__(self, past: State, tick: Int[Array, ""], key: Key[Array, ""]) -> State:
        """Scale the velocity."""
        x = _newest(past)
        return State(x.p, x.R, self.scale.astype(x.v.dtype) * x.v)


class DriftingPosition(AbstractMeasurementFault):
    """The position drifts back and forth, as a camera-based estimate does; the velocity does not contain the drift."""

    amplitude: Float[Array, "3"]
    """Amplitude in the world frame [m]."""
    period: Float[Array, ""]
    """Period [ticks]."""

    def __call__(self, past: State, tick: Int[Array, ""], key: Key[Array, ""]) -> State:
        """Add the drift of this tick."""
        x = _newest(past)
        phase = 2.0 * jnp.pi * tick.astype(x.p.dtype) / self.period.astype(x.p.dtype)
        return State(x.p + jnp.sin(phase) * self.amplitude.astype(x.p.dtype), x.R, x.v)


class Gaps(AbstractMeasurementFault):
    """Measurements are periodically missing for a while; the vehicle continues with the last command."""

    every: int = eqx.field(static=True)
    """Time between two gaps [ticks]."""
    duration: int = eqx.field(static=True)
    """Length of a gap [ticks]."""
    interrupts: ClassVar[bool] = True

    def __call__(self, past: State, tick: Int[Array, ""], key: Key[Array, ""]) -> State:
        """Return the newest measurement."""
        return _newest(past)

    def is_missing(self, tick: int) -> bool:
        """Return whether the tick lies in a gap."""
        return tick >= self.every and tick % self.every < self.duration


class JumpingClock(AbstractMeasurementFault):
    """The measurement clock jumps ahead, and later back again."""

    every: int = eqx.field(static=True)
    """Time between two jumps [ticks]."""
    jump: float = eqx.field(static=True)
    """Size of a jump [s]."""
    interrupts: ClassVar[bool] = True

    def __call__(self, past: State, tick: Int[Array, ""], key: Key[Array, ""]) -> State:
        """Return the newest measurement."""
        return _newest(past)

    def clock_error(self, tick: int) -> float:
        """Return the jump in every other interval, and 0 otherwise."""
        return self.jump if tick // self.every % 2 else 0.0


def _newest(past: State) -> State:
    return jax.tree.map(lambda leaf: leaf[-1], past)  # type: ignore[no-any-return]
