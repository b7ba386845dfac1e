"""Interface of a trajectory: the point at a given time, the distance to the path, and a change of frame."""

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
    """Position in the world frame [m]."""
    v: Float[Array, "3"]
    """Velocity in the world frame [m/s]."""
    u: Float[Array, "4"]
    """Command that a point mass needs (differential flatness): c [m/s^2] and body rates [rad/s]; hover at a jump."""
    heading: Float[Array, ""]
    """Heading [rad]."""
    a: Float[Array, "3"]
    """Acceleration in the world frame [m/s^2]; this and the following fields are zero where ``u`` is hover."""
    jerk: Float[Array, "3"]
    """Jerk in the world frame [m/s^3]."""
    heading_rate: Float[Array, ""]
    """Heading rate [rad/s]."""

    @classmethod
    def of(cls, p: Array, v: Array, a: Array, jerk: Array, heading: Array, heading_rate: Array) -> "Point":
        """Return the point with the command that a point mass needs; the arguments are the fields of these names."""
        thrust = a + jnp.array([0.0, 0.0, STANDARD_GRAVITY], dtype=a.dtype)
        return cls(p, v, flat_command(thrust, jerk, heading, heading_rate), heading, a, jerk, heading_rate)


class AbstractReference(eqx.Module):
    """A trajectory to track."""

    if TYPE_CHECKING:  # to a type checker an abstract variable would be a dataclass field

        @property
        def lap(self) -> Float[Array, "2"]:
            """Start and end of the repeating lap [s]; equal if the end is held."""

        @property
        def joins(self) -> Float[Array, "m 2"]:
            """Time spans in which a roll-out may start [s]; each is equally likely."""
    else:
        lap: eqx.AbstractVar[Array]
        joins: eqx.AbstractVar[Array]

    @abc.abstractmethod
    def __call__(self, t: Float[Array, ""]) -> Point:
        """Return the reference at time ``t`` [s]."""

    @abc.abstractmethod
    def distance(self, p: Float[Array, "3"]) -> Float[Array, ""]:
        """Return the cross-track error [m]: the distance from ``p`` to the nearest point of the lap.

        Without a lap, it is the distance to the nearest point of the whole trajectory.
        """

    def phase(self, t: Float[Array, ""]) -> Float[Array, ""]:
        """Return the time along the path at flight time ``t`` [s]; by default, both times are equal."""
        return t

    def pace(self, t: Float[Array, ""]) -> Float[Array, ""]:
        """Return the rate of the phase at flight time ``t``; 1 by default."""
        return jnp.ones_like(t)

    @property
    def phase_lap(self) -> Float[Array, "2"]:
        """Start and end of the repeating lap as phases [s]."""
        return self.lap

    @abc.abstractmethod
    def in_frame(self, frame: EffectiveGravityFrame) -> "AbstractReference":
        """Return the same trajectory in the coordinates of ``frame``."""


class TurnedReference(AbstractReference):
    """A reference in the effective-gravity frame; its command follows from flatness in this frame."""

    reference: AbstractReference
    frame: EffectiveGravityFrame

    @property
    def lap(self) -> Float[Array, "2"]:
        """Lap of the reference [s]; times are the same in the frame."""
        return self.reference.lap

    @property
    def joins(self) -> Float[Array, "m 2"]:
        """Time spans in which a roll-out may start [s]; times are the same in the frame."""
        return self.reference.joins

    def __call__(self, t: Float[Array, ""]) -> Point:
        """Return the rotated and scaled reference at ``t``; headings are about the frame's vertical."""
        here, vector = self.reference(t), self.frame.vector
        p, v, a, jerk = (vector(field) for field in (here.p, here.v, here.a, here.jerk))
        return Point.of(p, v, a, jerk, here.heading, here.heading_rate)

    def distance(self, p: Float[Array, "3"]) -> Float[Array, ""]:
        """Return the cross-track error, measured in the frame [m]."""
        return self.frame.scale * self.reference.distance(so3.act(self.frame.Q.T, p) / self.frame.scale)

    def in_frame(self, frame: EffectiveGravityFrame) -> "TurnedReference":
        """Return the reference in a further frame, applied after this one."""
        return TurnedReference(self, frame)
