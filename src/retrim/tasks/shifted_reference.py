"""A reference with laps whose path is shifted by a periodic function of the phase."""

import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..physics.effective_gravity import EffectiveGravityFrame
from .abstract_reference import AbstractReference, Point, TurnedReference
from .reference import Reference

HARMONICS = 10


class ShiftedReference(AbstractReference):
    """A reference plus a Fourier series over its lap; without a lap, the reference is not shifted."""

    reference: Reference
    shift: Float[Array, "3 h"]
    """Coefficients of the shift [m]: the constant, and the cosine and sine of each harmonic."""

    @classmethod
    def of(cls, reference: Reference) -> "ShiftedReference":
        """Return a reference with a shift of zero."""
        return cls(reference, jnp.zeros((3, 1 + 2 * HARMONICS), dtype=reference.rows.dtype))

    @property
    def lap(self) -> Float[Array, "2"]:
        """Lap of the reference [s]."""
        return self.reference.lap

    @property
    def joins(self) -> Float[Array, "m 2"]:
        """Time spans in which a roll-out may start [s]."""
        return self.reference.joins

    def __call__(self, t: Float[Array, ""]) -> Point:
        """Return the shifted reference at time ``t`` [s]."""
        here = self.reference(t)
        own = (here.p, here.v, here.a, here.jerk)
        p, v, a, jerk = (part + self.shift @ basis(self.lap, t, order) for order, part in enumerate(own))
        return Point.of(p, v, a, jerk, here.heading, here.heading_rate)

    def distance(self, p: Float[Array, "3"]) -> Float[Array, ""]:
        """Return the cross-track error with respect to the path without the shift [m]."""
        return self.reference.distance(p)

    def in_frame(self, frame: EffectiveGravityFrame) -> TurnedReference:
        """Return the trajectory in the coordinates of ``frame``."""
        return TurnedReference(self, frame)


def basis(lap: Float[Array, "2"], t: Float[Array, ""], order: int = 0) -> Float[Array, " h"]:
    """Return the values of the series' functions, or of their derivatives, at time ``t``; zero without a lap.

    Args:
        lap: Start and end of the lap [s].
        t: Time [s].
        order: Order of the derivative.
    """
    length = lap[1] - lap[0]
    rate = 2.0 * math.pi / jnp.where(length > 0.0, length, 1.0)
    k = jnp.arange(1, HARMONICS + 1, dtype=rate.dtype)
    angles = k * (rate * (t - lap[0]).astype(rate.dtype)) + 0.5 * math.pi * order
    scale = (k * rate) ** order
    first = jnp.full((1,), 0.0 if order else 1.0, rate.dtype)
    values = jnp.concatenate([first, scale * jnp.cos(angles), scale * jnp.sin(angles)])
    return jnp.where(length > 0.0, values, 0.0)


def shift_references(tree: Any) -> Any:
    """Return a pytree, such as a controller, in which every tabulated reference can be shifted."""

    def wrap(part: Any) -> Any:
        return ShiftedReference.of(part) if isinstance(part, Reference) else part

    return jax.tree.map(wrap, tree, is_leaf=lambda part: isinstance(part, Reference))


def set_shift(tree: Any, shift: Float[Array, "3 h"]) -> Any:
    """Return a pytree in which every shifted reference has the given coefficients [m]."""

    def adjust(part: Any) -> Any:
        return dataclasses.replace(part, shift=shift) if isinstance(part, ShiftedReference) else part

    return jax.tree.map(adjust, tree, is_leaf=lambda part: isinstance(part, ShiftedReference))
