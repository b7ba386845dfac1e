"""A reference whose time runs faster or slower than the time of the flight."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..physics.effective_gravity import EffectiveGravityFrame
from .abstract_reference import AbstractReference, Point, TurnedReference
from .reference import Reference
from .shifted_reference import ShiftedReference

TABLES = (Reference, ShiftedReference)
PACE_CHANGE_TIME = 0.4  # [s], time during which the pace of a clock changes


class Clock(eqx.Module):
    """Relation between flight time t and the time along a reference, the phase.

    After the instant ``t``, the phase is phase + pace (tau + growth tau^2 / 2), with tau the time since this instant.
    The pace is constant from 0.4 s on, so that it remains positive if no new clock follows.
    """

    t: Float[Array, ""]
    """Flight time of the instant [s]."""
    phase: Float[Array, ""]
    """Phase at this instant [s]."""
    pace: Float[Array, ""]
    """Rate of the phase at this instant, in seconds of the reference per second of flight."""
    growth: Float[Array, ""]
    """Relative growth of the pace [1/s]."""

    @classmethod
    def at_pace(cls, pace: Float[Array, ""]) -> "Clock":
        """Return a clock that runs at a constant pace from the start of the flight."""
        zero = jnp.zeros_like(pace)
        return cls(zero, zero, pace, zero)

    def phase_at(self, t: Float[Array, ""]) -> Float[Array, ""]:
        """Return the phase at flight time ``t`` [s]."""
        tau = (t - self.t).astype(self.phase.dtype)
        growing = jnp.minimum(tau, PACE_CHANGE_TIME)
        return self.phase + self.pace * (tau + self.growth * growing * (tau - 0.5 * growing))

    def pace_at(self, t: Float[Array, ""]) -> Float[Array, ""]:
        """Return the pace at flight time ``t`` [s]."""
        return self.pace * (1.0 + self.growth * jnp.minimum((t - self.t).astype(self.phase.dtype), PACE_CHANGE_TIME))

    def time_of(self, phase: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Return the flight time at which a phase is reached if the present pace remains constant [s]."""
        return self.t + (phase - self.phase) / self.pace


class PacedReference(AbstractReference):
    """A reference that is followed at the pace of a clock."""

    reference: AbstractReference
    clock: Clock

    @property
    def lap(self) -> Float[Array, "2"]:
        """Lap of the reference at the present pace, in flight time [s]."""
        return self.clock.time_of(self.reference.lap)

    @property
    def joins(self) -> Float[Array, "m 2"]:
        """Time spans in which a roll-out may start at the present pace, in flight time [s]."""
        return self.clock.time_of(self.reference.joins)

    def __call__(self, t: Float[Array, ""]) -> Point:
        """Return the reference at flight time ``t`` [s]; its derivatives follow from the chain rule."""
        here = self.reference(self.clock.phase_at(t))
        return at_pace(here, self.clock.pace_at(t), self.clock.pace * self.clock.growth)

    def phase(self, t: Float[Array, ""]) -> Float[Array, ""]:
        """Return the phase of the clock [s]."""
        return self.clock.phase_at(t)

    def pace(self, t: Float[Array, ""]) -> Float[Array, ""]:
        """Return the pace of the clock."""
        return self.clock.pace_at(t)

    @property
    def phase_lap(self) -> Float[Array, "2"]:
        """Lap of the reference as phases [s]."""
        return self.reference.lap

    def distance(self, p: Float[Array, "3"]) -> Float[Array, ""]:
        """Return the cross-track error [m], which does not depend on the pace."""
        return self.reference.distance(p)

    def in_frame(self, frame: EffectiveGravityFrame) -> TurnedReference:
        """Return the trajectory in the coordinates of ``frame``."""
        return TurnedReference(self, frame)


def at_pace(here: Point, pace: Float[Array, ""], change: Float[Array, ""]) -> Point:
    """Return a point of a reference that is followed at a different pace.

    Args:
        here: Point at the phase, with derivatives with respect to the phase.
        pace: Rate of the phase [-].
        change: Rate of the pace [1/s].
    """
    v = pace * here.v
    a = pace * pace * here.a + change * here.v
    jerk = pace * pace * pace * here.jerk + 3.0 * pace * change * here.a
    return Point.of(here.p, v, a, jerk, here.heading, pace * here.heading_rate)


def set_clock(tree: Any, clock: Clock) -> Any:
    """Return a pytree, such as a task or a controller, in which every paced reference has the given clock."""

    def adjust(part: Any) -> Any:
        return dataclasses.replace(part, clock=clock) if isinstance(part, PacedReference) else part

    return jax.tree.map(adjust, tree, is_leaf=lambda part: isinstance(part, PacedReference))


def pace_references(tree: Any, clock: Clock) -> Any:
    """Return a pytree, such as a task or a controller, in which every tabulated reference follows a clock."""

    def wrap(part: Any) -> Any:
        return PacedReference(part, clock) if isinstance(part, TABLES) else part

    return jax.tree.map(wrap, tree, is_leaf=lambda part: isinstance(part, TABLES))
