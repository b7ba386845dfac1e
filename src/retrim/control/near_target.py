"""Limit the distance from the target in a controller's input."""

import math
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..physics.effective_gravity import EffectiveGravityFrame
from ..physics.state import STANDARD_GRAVITY, Command, State
from ..physics.vehicle import Vehicle
from ..tasks.task import AbstractTask
from .wrapped_controller import WrappedController

WEAK_REACH = 0.5  # [m], for a vehicle whose thrust is 1.8 times its weight; from 0.8 m, such vehicles fall
REACH_PER_G = WEAK_REACH / math.sqrt(1.8**2 - 1.0)  # [m] per horizontal acceleration of 1 g that the vehicle can hold
LARGEST_REACH = 1.0  # [m]: an unknown load may take a large part of a strong vehicle's thrust


def safe_reach(vehicle: Vehicle) -> Float[Array, ""]:
    """Return the largest distance from the target at which a policy does not tilt too far for the vehicle's thrust [m].

    A vehicle whose thrust is r times its weight can hold its height up to a horizontal acceleration of sqrt(r^2 - 1) g.
    The reach is proportional to this acceleration, and at most :data:`LARGEST_REACH`.

    Args:
        vehicle: Vehicle with its mass and its largest thrust.
    """
    ratio = vehicle.thrust_max / (vehicle.mass * STANDARD_GRAVITY)
    level = jnp.sqrt(jnp.maximum(ratio**2 - 1.0, 0.04))  # [g]; the policy of a vehicle that cannot hover still steers
    return jnp.minimum(REACH_PER_G * level, LARGEST_REACH)


class NearTarget(WrappedController[Any]):
    """Limits the position that a controller receives to within ``reach`` of the target.

    A policy's commands grow with this distance. From far away, a policy may tilt so far that a weak vehicle falls. If
    measurements are late, it may oscillate and crash there, although it is stable near its target.
    """

    task: AbstractTask
    """Task, which provides the target."""
    reach: Float[Array, ""]
    """Largest distance in the input, in the controller's coordinates [m]."""

    def _inner_memory(self, memory: Any) -> Any:
        return memory

    def init(self, x: State) -> Any:
        """Return the memory of the inner controller."""
        return self.inner.init(x)

    def __call__(self, memory: Any, t: Float[Array, ""], x: State) -> tuple[Command, Any]:
        """Return the command of the inner controller for the limited distance."""
        target = self.task.target(t)
        away = x.p - target
        distance = jnp.sqrt(jnp.sum(away * away) + 1e-12)
        reach = self.reach.astype(x.p.dtype)
        near = jnp.where(distance > reach, target + away * (reach / distance), x.p)
        return self.inner(memory, t, State(near, x.R, x.v))

    def accept(self, memory: Any, u: Command) -> Any:
        """Pass the accepted command to the inner controller."""
        return self.inner.accept(memory, u)

    def in_frame(self, frame: EffectiveGravityFrame) -> "NearTarget":
        """Return the same controller for states and commands in ``frame``."""
        return NearTarget(self.inner.in_frame(frame), self.task.in_frame(frame), self.reach)
