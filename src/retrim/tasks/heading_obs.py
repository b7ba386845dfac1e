"""Observation in axes that turn with the heading, so the observation is the same for every heading."""

import dataclasses
from typing import Any, TypeVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..physics import so3
from ..physics.effective_gravity import EffectiveGravityFrame
from ..physics.state import Command, State
from .observation import AbstractObservation
from .wrapped_observation import AbstractWrappedObservation

M = TypeVar("M")
SMALLEST = 1e-6  # regularises the length of the heading, which is zero if the vehicle is upside down


class HeadingObs(AbstractWrappedObservation[M]):
    """Observation of the state turned about the vertical through ``origin``, so that the heading is zero.

    Hover is the same for every heading: thrust and body rates are commands in body axes, and the reward does not depend
    on the heading. A policy that observes the heading must learn every heading, and then oscillates at some headings
    and rests at others. The heading is the twist of the attitude about the vertical, which is smooth up to a tilt of
    180 degrees.
    """

    origin: Float[Array, "3"]
    """Point on the vertical in the world frame [m]."""

    def init(self, x: State) -> M:
        """Return the memory of the inner observation."""
        return self.inner.init(self._turn(x))

    def __call__(self, memory: M, t: Float[Array, ""], x: State, last: Command) -> tuple[Float[Array, " o"], M]:
        """Return the observation of the turned state."""
        return self.inner(memory, t, self._turn(x), last)

    def in_frame(self, frame: EffectiveGravityFrame) -> "HeadingObs[M]":
        """Return the observation about the vertical of ``frame``."""
        inner_in_frame: AbstractObservation[Any] = self.inner.in_frame(frame)
        return dataclasses.replace(self, inner=inner_in_frame, origin=frame.vector(self.origin))

    def _turn(self, x: State) -> State:
        cosine, sine = x.R[0, 0] + x.R[1, 1], x.R[1, 0] - x.R[0, 1]
        length = jnp.sqrt(cosine**2 + sine**2 + SMALLEST**2)
        c, s, zero = cosine / length, sine / length, jnp.zeros_like(length)
        back = jnp.array([[c, s, zero], [-s, c, zero], [zero, zero, zero + 1.0]])
        origin = self.origin.astype(x.p.dtype)
        return State(origin + so3.act(back, x.p - origin), so3.mul(back, x.R), so3.act(back, x.v))
