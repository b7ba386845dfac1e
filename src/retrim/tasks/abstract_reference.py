"""Interface of a trajectory: a point at a time, the distance from it, and the trajectory in another frame."""

import abc
from typing import TYPE_CHECKING, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..physics import so3
from ..physics.effective_gravity import EffectiveGravityFrame
from ..physics.state import STANDARD_GRAVITY
from .flatness import flat_command


class Point(NamedTuple):
    """A reference at one instant."""

    p: Float[Array, "3"]
    """Position, world [m]."""
    v: Float[Array, "3"]
    """Velocity, world [m/s]."""
    u: Float[Array, "4"]
    """Command for a point mass (differential flatness): c [m/s^2], body rates [rad/s]; hover at a jump."""
    heading: Float[Array, ""]
    """Heading [rad]."""
    a: Float[Array, "3"]
    """Acceleration, world [m/s^2]; this and the following fields are zero where ``u`` is hover."""
    jerk: Float[Array, "3"]
    """Jerk, world [m/s^3]."""
    heading_rate: Float[Array, ""]
    """Rate of the heading [rad/s]."""


class AbstractReference(eqx.Module):
    """A trajectory to track."""

    if TYPE_CHECKING:  # to a type checker an abstract variable would be a dataclass field

        @property
        def lap(self) -> Float[Array, "2"]:
            """Start and end of the lap that repeats [s]; two equal values if the end is held."""

        @property
        def joins(self) -> Float[Array, "m 2"]:
            """Spans of time in which a roll-out may start [s]; each is equally likely."""
    else:
        lap: eqx.AbstractVar[Array]
        joins: eqx.AbstractVar[Array]

    @abc.abstractmethod
    def __call__(self, t: Float[Array, ""]) -> Point:
        """Return the reference at time ``t`` [s]."""

    @abc.abstractmethod
    def distance(self, p: Float[Array, "3"]) -> Float[Array, ""]:
        """Return the cross-track error: from ``p`` to the nearest point of the lap, or of the whole trajectory [m]."""

    @abc.abstractmethod
    def in_frame(self, frame: EffectiveGravityFrame) -> "AbstractReference":
        """Return the same trajectory in the coordinates of ``frame``."""


class TurnedReference(AbstractReference):
    """A reference in the frame of the effective gravity; its command follows from flatness in this frame."""

    reference: AbstractReference
    frame: EffectiveGravityFrame

    @property
    def lap(self) -> Float[Array, "2"]:
        """Lap of the reference [s]; times are the same in the frame."""
        return self.reference.lap

    @property
    def joins(self) -> Float[Array, "m 2"]:
        """Spans of the reference [s]; times are the same in the frame."""
        return self.reference.joins

    def __call__(self, t: Float[Array, ""]) -> Point:
        """Return the turned and scaled reference at ``t``; headings are about the vertical of the frame."""
        here, vector = self.reference(t), self.frame.vector
        a, jerk = vector(here.a), vector(here.jerk)
        thrust = a + jnp.array([0.0, 0.0, STANDARD_GRAVITY], dtype=a.dtype)
        u = flat_command(thrust, jerk, here.heading, here.heading_rate)
        return Point(vector(here.p), vector(here.v), u, here.heading, a, jerk, here.heading_rate)

    def distance(self, p: Float[Array, "3"]) -> Float[Array, ""]:
        """Return the cross-track error in metres of the frame."""
        return self.frame.scale * self.reference.distance(so3.act(self.frame.Q.T, p) / self.frame.scale)

    def in_frame(self, frame: EffectiveGravityFrame) -> "TurnedReference":
        """Return the reference in another frame on top of this one."""
        return TurnedReference(self, frame)
