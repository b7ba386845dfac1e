"""Transform states and commands to the frame of the effective gravity.

A constant disturbance tilts and scales gravity. With the effective gravity gamma = g + d, let Q be the smallest
rotation that takes -gamma/|gamma| to the vertical, and s = |g| / |gamma|. If p, R and v satisfy Eq. (1) of the paper
with the thrust c and the disturbance d, then s Q p, Q R and s Q v satisfy Eq. (1) with the thrust s c and without a
disturbance. The equation is equivariant under rotations, and under a change of the unit of length with an unchanged
unit of time.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from . import so3
from .actuator_response import ActuatorState
from .state import STANDARD_GRAVITY, Command, State


class EffectiveGravityFrame(eqx.Module):
    """A frame in which g + d is standard gravity, straight down."""

    Q: Float[Array, "3 3"]
    """Rotation into the frame."""
    scale: Float[Array, ""]
    """Length in the frame that corresponds to one metre in the world."""
    d: Float[Array, "3"]
    """Disturbance that is part of the frame's gravity, world [m/s^2]."""

    @classmethod
    def of(cls, d: Float[Array, "3"]) -> "EffectiveGravityFrame":
        """Return the frame of g + ``d``, with ``d`` in the world frame [m/s^2].

        The frame is defined for every ``d`` whose vertical part is smaller than gravity, but not for a weightless
        vehicle.
        """
        up = -d + jnp.array([0.0, 0.0, STANDARD_GRAVITY], dtype=d.dtype)
        strength = jnp.sqrt(jnp.sum(up * up))
        a, b, c = up / strength
        # Rodrigues' formula for the smallest rotation that takes (a, b, c) to (0, 0, 1).
        k = 1.0 / (1.0 + c)
        Q = jnp.stack(
            [
                jnp.stack([1.0 - k * a * a, -k * a * b, -a]),
                jnp.stack([-k * a * b, 1.0 - k * b * b, -b]),
                jnp.stack([a, b, c]),
            ]
        )
        return cls(Q, STANDARD_GRAVITY / strength, d)

    def vector(self, y: Float[Array, "3"]) -> Float[Array, "3"]:
        """Transform a position, velocity, acceleration or jerk from the world to the frame."""
        return self.scale * so3.act(self.Q, y)

    def state(self, x: State) -> State:
        """Transform a state from the world to the frame."""
        return State(self.vector(x.p), so3.mul(self.Q, x.R), self.vector(x.v))

    def world_state(self, x: State) -> State:
        """Transform a state from the frame to the world."""
        back = so3.mul(self.Q.T, x.R)
        return State(so3.act(self.Q.T, x.p) / self.scale, back, so3.act(self.Q.T, x.v) / self.scale)

    def command(self, u: Command) -> Command:
        """Transform a command from the world to the frame; the body rates are unchanged."""
        return Command(self.scale * u.c, u.omega)

    def actuators(self, s: ActuatorState) -> ActuatorState:
        """Transform thrust and body rates from the world to the frame; the body rates are unchanged."""
        return ActuatorState(self.command(s.command), s.slope)

    def world_command(self, u: Command) -> Command:
        """Transform a command from the frame to the world."""
        return Command(u.c / self.scale, u.omega)
