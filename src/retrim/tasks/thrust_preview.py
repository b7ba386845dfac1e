"""Observation of a tracking policy in body axes: the tracking error, and the thrust that the path needs from now on.

The tracking error e of a point mass follows e'' = R c e3 - f(t). Here, f = a_ref + g e3 - d is the mass-normalised
thrust that the path needs, and d is the expected disturbance. Path, gravity and disturbance appear only in f. In body
axes, a policy therefore receives the same numbers for every position, heading, tilt and direction of gravity. A
disturbance that is known ahead is one more part of the path.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from ..physics import so3
from ..physics.dynamics import Residual
from ..physics.effective_gravity import EffectiveGravityFrame
from ..physics.state import STANDARD_GRAVITY, Command, State
from .abstract_reference import AbstractReference, Point
from .observation import AbstractObservation, with_command

POINTS, STEP = 7, 0.04  # number of previewed thrusts, and the time between them [s]
POSITION_SCALE = 0.5  # [m]
SPEED_SCALE = 1.0  # [m/s]
PASSES, SHARE = 3, 0.6  # the disturbance depends on the attitude, which depends on the disturbance
UPWARD = 1.0  # [m/s^2]: a thrust with a smaller norm has no direction


class ThrustPreview(AbstractObservation[Float[Array, "history 4"]]):
    """o = R^T [p_ref - p, v_ref - v, f(t), f(t + 0.04 s), ..., nose], and the last commands.

    In the frame of effective gravity, lengths and thrusts have the scale of this frame.
    """

    reference: AbstractReference
    omega_max: Float[Array, "3"]
    history: int = eqx.field(static=True, default=2)
    residual: Residual | None = None
    """Expected acceleration beyond the nominal model, as a function of state and command, world [m/s^2]."""
    frame: EffectiveGravityFrame | None = None
    """Frame in which states and commands are given; None for the world frame."""

    @property
    def size(self) -> int:
        """Length of the observation: 8 + 3 :data:`POINTS` + 4 ``history``."""
        return 8 + 3 * POINTS + 4 * self.history

    @property
    def previews_residual(self) -> bool:
        """Whether a learned residual belongs to the observation; true."""
        return True

    def with_residual(self, residual: Residual) -> "ThrustPreview":
        """Return the same observation with an expected disturbance along the reference."""
        return dataclasses.replace(self, residual=residual)

    def in_frame(self, frame: EffectiveGravityFrame) -> "ThrustPreview":
        """Return the same observation for states and commands in ``frame``."""
        return dataclasses.replace(self, frame=frame)

    def init(self, x: State) -> Float[Array, "history 4"]:
        """Return the memory of a vehicle that has hovered until now."""
        return jnp.zeros((self.history, 4), dtype=x.p.dtype)

    def __call__(
        self, memory: Float[Array, "history 4"], t: Float[Array, ""], x: State, last: Command
    ) -> tuple[Float[Array, " o"], Float[Array, "history 4"]]:
        """Return the tracking error and the previewed thrust in body axes, with the nose and the last commands."""
        memory = with_command(memory, last, self.omega_max)
        scale, push = jnp.ones_like(x.p[0]), jnp.zeros_like(x.p)
        if self.frame is not None:
            x, last = self.frame.world_state(x), self.frame.world_command(last)
            scale, push = self.frame.scale, self.frame.d
        ahead = jax.vmap(self.reference)(t + STEP * jnp.arange(POINTS, dtype=t.dtype))
        thrusts = ahead.a + (jnp.array([0.0, 0.0, STANDARD_GRAVITY], dtype=push.dtype) - push)[None]
        if self.residual is not None:
            here = self.residual(x, last)
            thrusts = thrusts - lax.stop_gradient(here[None] + self._change(self.residual, ahead, thrusts))
        heading = ahead.heading[0]
        nose = jnp.stack([jnp.cos(heading), jnp.sin(heading), jnp.zeros_like(heading)])
        # The nose that a vehicle with this heading has if its thrust is that of the reference.
        z = _unit(thrusts[0])
        nose = _unit(nose - z * jnp.sum(z * nose))
        world = [
            (ahead.p[0] - x.p)[None] * scale / POSITION_SCALE,
            (ahead.v[0] - x.v)[None] * scale / SPEED_SCALE,
            thrusts * scale / STANDARD_GRAVITY,
            nose[None],
        ]
        body = jax.vmap(lambda y: so3.act(x.R.T, y))(jnp.concatenate(world)).reshape(-1)
        return jnp.concatenate([body[:-1], memory.reshape(-1)]), memory

    def _change(self, residual: Residual, ahead: Point, thrusts: Float[Array, "points 3"]) -> Float[Array, "points 3"]:
        """Return the change of the residual along the reference, from now on [m/s^2]."""

        def along(p: Array, v: Array, heading: Array, thrust: Array) -> Array:
            def at(f: Array) -> Array:
                c = jnp.sqrt(jnp.sum(f * f) + UPWARD**2)
                return residual(State(p, _attitude(f, heading), v), Command(c, jnp.zeros_like(p)))

            r = at(thrust)
            for _ in range(PASSES - 1):
                r = (1.0 - SHARE) * r + SHARE * at(thrust - r)
            return r

        values = jax.vmap(along)(ahead.p, ahead.v, ahead.heading, thrusts)
        return values - values[:1]


def _unit(y: Float[Array, "3"]) -> Float[Array, "3"]:
    return y / jnp.sqrt(jnp.sum(y * y) + 1e-9)


def _attitude(thrust: Float[Array, "3"], heading: Float[Array, ""]) -> Float[Array, "3 3"]:
    """Return the attitude with the z axis along ``thrust`` and the x axis towards ``heading``."""
    z = _unit(thrust)
    y = _unit(jnp.cross(z, jnp.stack([jnp.cos(heading), jnp.sin(heading), jnp.zeros_like(heading)])))
    return jnp.stack([jnp.cross(y, z), y, z], axis=1)
