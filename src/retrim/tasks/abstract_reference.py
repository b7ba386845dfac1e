"""What follows a trajectory sees of it: a point at a time, how far it is, and how it looks in another frame."""

import abc
from typing import TYPE_CHECKING, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..physics import so3
from ..physics.felt_frame import FeltFrame
from ..physics.state import STANDARD_GRAVITY
from .flatness import flat_command


class Point(NamedTuple):
    """A reference at one instant."""

    p: Float[Array, "3"]
    """World [m]."""
    v: Float[Array, "3"]
    """World [m/s]."""
    u: Float[Array, "4"]
    """Command that a point mass needs (differential flatness): c [m/s^2], body rates [rad/s]; hover at a jump."""
    heading: Float[Array, ""]
    """[rad]"""
    a: Float[Array, "3"]
    """Acceleration, world [m/s^2]; zero where ``u`` is hover, as is what follows."""
    jerk: Float[Array, "3"]
    """World [m/s^3]."""
    heading_rate: Float[Array, ""]
    """[rad/s]"""


class AbstractReference(eqx.Module):
    """A trajectory to track."""

    if TYPE_CHECKING:  # to a type checker an abstract variable would be a dataclass field

        @property
        def lap(self) -> Float[Array, "2"]:
            """Start and end of the lap that repeats [s]; the same twice: the end is held."""

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
        """Return the cross-track error: from ``p`` to the nearest point of the lap, or of all without a lap [m]."""

    @abc.abstractmethod
    def in_frame(self, frame: FeltFrame) -> "AbstractReference":
        """Return the same trajectory as it is in ``frame``."""


class TurnedReference(AbstractReference):
    """A reference in the frame of the gravity that a vehicle feels; its command is that of flatness there."""

    reference: AbstractReference
    frame: FeltFrame

    @property
    def lap(self) -> Float[Array, "2"]:
        """Times are the same in the frame [s]."""
        return self.reference.lap

    @property
    def joins(self) -> Float[Array, "m 2"]:
        """Times are the same in the frame [s]."""
        return self.reference.joins

    def __call__(self, t: Float[Array, ""]) -> Point:
        """Turn and scale the reference at ``t``; headings are about the vertical of the frame."""
        here, vector = self.reference(t), self.frame.vector
        a, jerk = vector(here.a), vector(here.jerk)
        thrust = a + jnp.array([0.0, 0.0, STANDARD_GRAVITY], dtype=a.dtype)
        u = flat_command(thrust, jerk, here.heading, here.heading_rate)
        return Point(vector(here.p), vector(here.v), u, here.heading, a, jerk, here.heading_rate)

    def distance(self, p: Float[Array, "3"]) -> Float[Array, ""]:
        """Return the cross-track error in metres of the frame."""
        return self.frame.scale * self.reference.distance(so3.act(self.frame.Q.T, p) / self.frame.scale)

    def in_frame(self, frame: FeltFrame) -> "TurnedReference":
        """Turn it once more."""
        return TurnedReference(self, frame)
