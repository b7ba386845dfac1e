"""Learn the tracking error that repeats on every lap, and shift the reference against it.

A policy follows a fast path with an error that is the same on every lap: it is late, it cuts corners, and its model
lacks a part of the drag. The shift is a Fourier series of the phase. Each coefficient integrates the error times its
own function, as in adaptive feed-forward cancellation, so the error vanishes at each harmonic that the vehicle can
follow (Bodson, Sacks and Khosla 1994).
"""

import dataclasses
import math
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..physics.state import Command, State
from ..tasks.abstract_reference import AbstractReference
from ..tasks.reference import Reference
from ..tasks.shifted_reference import HARMONICS, basis, set_shift, shift_references
from .controller import AbstractController
from .wrapped_controller import WrappedController

RATE = 0.15  # [1/s], rate at which the error of a slow harmonic decays; at 0.6, the vehicle swings up
BANDWIDTH = 6.0  # [rad/s]; faster harmonics are learned more slowly, since a vehicle follows them late
LARGEST_ERROR = 0.5  # [m]: errors farther away are not those of the lap
LARGEST = 0.3  # [m], largest amplitude of a coefficient


class LapState(eqx.Module):
    """Memory of the learning and of the inner controller."""

    shift: Float[Array, "3 h"]
    """Coefficients of the shift [m]."""
    inner: Any


class LapLearning(WrappedController[LapState]):
    """Shifts the reference of a controller by a periodic function of the phase, until the mean error vanishes."""

    reference: AbstractReference
    """Reference of the flight, world frame."""
    dt: float = eqx.field(static=True)
    """Control tick [s]."""
    age: Float[Array, ""] = eqx.field(default_factory=lambda: jnp.array(0.0))
    """Age of measurements [s]."""

    @classmethod
    def of(cls, controller: AbstractController[Any], reference: Reference, dt: float) -> "LapLearning":
        """Return a controller that learns the error of its laps.

        Args:
            controller: Controller with tabulated references.
            reference: Reference of the flight.
            dt: Control tick [s].
        """
        return cls(shift_references(controller), reference, dt)

    def with_age(self, age: float | Float[Array, ""]) -> "LapLearning":
        """Return the same controller for measurements that are ``age`` seconds old."""
        return dataclasses.replace(super().with_age(age), age=jnp.array(age))

    def init(self, x: State) -> LapState:
        """Return the memory at the start of a flight, without a shift."""
        shift = jnp.zeros((3, 1 + 2 * HARMONICS), dtype=x.p.dtype)
        return LapState(shift, set_shift(self.inner, shift).init(x))

    def __call__(self, memory: LapState, t: Float[Array, ""], x: State) -> tuple[Command, LapState]:
        """Correct the shift by the present error, and return the command of the inner controller."""
        vehicle = self.inner.vehicle(memory.inner)
        age = self.age if vehicle is None else vehicle.age(self.age)
        shift = self._correct(memory.shift, t - age.astype(t.dtype), x)
        u, inner = set_shift(self.inner, shift)(memory.inner, t, x)
        return u, LapState(shift, inner)

    def accept(self, memory: LapState, u: Command) -> LapState:
        """Pass the accepted command to the inner controller."""
        return LapState(memory.shift, set_shift(self.inner, memory.shift).accept(memory.inner, u))

    def _correct(self, shift: Float[Array, "3 h"], t: Float[Array, ""], x: State) -> Float[Array, "3 h"]:
        phase, lap = self.reference.phase(t), self.reference.phase_lap
        error = x.p - self.reference(t).p
        is_lap = (phase > lap[0]) & (jnp.sum(error * error) < LARGEST_ERROR**2)
        k = jnp.arange(1, HARMONICS + 1, dtype=shift.dtype)
        frequency = k * (2.0 * math.pi * self.reference.pace(t) / jnp.where(lap[1] > lap[0], lap[1] - lap[0], 1.0))
        harmonics = 2.0 / (1.0 + (frequency / BANDWIDTH) ** 4)
        weights = jnp.concatenate([jnp.ones((1,), shift.dtype), harmonics, harmonics])
        change = -self.dt * RATE * error[:, None] * (weights * basis(lap, phase))[None]
        return jnp.clip(shift + jnp.where(is_lap, change, 0.0), -LARGEST, LARGEST)
