"""Tracking a reference (paper, Sec. IV-A.1)."""

import dataclasses
import math
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax import random
from jaxtyping import Array, Bool, Float, Key

from ..physics import so3
from ..physics.dynamics import Residual
from ..physics.effective_gravity import EffectiveGravityFrame
from ..physics.state import Command, State
from .abstract_reference import AbstractReference, Point
from .observation import AbstractObservation
from .task import AbstractTask, Start, huber, within

NOISE = 0.1 * math.pi  # [rad]


class AbstractTrack(AbstractTask):
    """Follow a reference in space and time; subclasses differ in their rewards.

    The task terminates when the vehicle is farther than ``box`` [m] from the reference along any axis.
    """

    reference: AbstractReference
    observation: AbstractObservation[Any]
    spread: Float[Array, ""]
    """Largest distance between a start and the reference along each axis [m]."""
    box: Float[Array, ""]
    """Half the side of the box that moves with the reference [m]."""
    dt: float = eqx.field(static=True, default=0.02)
    horizon: int = eqx.field(static=True, default=150)

    def reset(self, key: Key[Array, ""]) -> Start:
        """Draw a start near the reference, at a random time in one of its spans.

        The position is within ±``spread`` of the reference and the attitude within ±18 degrees, both per axis. The
        standard deviation of the velocity is 0.3 m/s per axis.
        """
        k_join, k_time, kp, ka, kv = random.split(key, 5)
        joins = self.reference.joins
        span = joins[random.randint(k_join, (), 0, joins.shape[0])]
        t = span[0] + (span[1] - span[0]) * random.uniform(k_time, (), joins.dtype)
        here = self.reference(t)
        p = here.p + self.spread * random.uniform(kp, (3,), here.p.dtype, minval=-1.0, maxval=1.0)
        R = so3.rotz(here.heading) @ so3.exp(NOISE * random.uniform(ka, (3,), here.p.dtype, minval=-1.0, maxval=1.0))
        return Start(t, State(p, R, here.v + 0.3 * random.normal(kv, (3,), here.p.dtype)))

    @property
    def approaches_target(self) -> bool:
        """Whether a policy may observe a limited distance from the reference; true."""
        return True

    @property
    def metric(self) -> str:
        """Name of the error metric in results."""
        return "tracking_error_m"

    @property
    def flight_seconds(self) -> float:
        """Default duration of a flight [s]: the paper's value, or less if a reference without a lap ends earlier."""
        start, end = (round(float(t), 3) for t in self.reference.lap)
        return 60.0 if start < end else min(60.0, max(end, 3.0))

    @property
    def steady_seconds(self) -> float:
        """Duration of the final part of a flight, over which the error is averaged to give the score [s]."""
        return 10.0

    def home(self) -> Float[Array, "3"]:
        """Return the start of the reference in the world frame [m]."""
        return _start(self.reference)

    def target(self, t: Float[Array, ""]) -> Float[Array, "3"]:
        """Return the reference position at time ``t`` [s] in the world frame [m]."""
        return self.reference(t).p

    def setpoint(self, t: Float[Array, ""]) -> Point:
        """Return the reference at time ``t`` [s]."""
        return self.reference(t)

    def terminated(self, t: Float[Array, ""], x: State) -> Bool[Array, ""]:
        """Return whether the vehicle is outside the box around the reference or its state is not finite."""
        return ~within(self.box, x, self.reference(t).p)

    def error(self, t: Float[Array, ""], x: State) -> Float[Array, ""]:
        """Return the distance from the reference position at ``t`` [m]."""
        return jnp.sqrt(jnp.sum((x.p - self.reference(t).p) ** 2))

    def cross_track(self, x: State) -> Float[Array, ""]:
        """Return the distance to the nearest point on the reference's lap [m]."""
        return self.reference.distance(x.p)

    def with_residual(self, residual: Residual) -> "AbstractTrack":
        """Return the task with the observation of an expected disturbance."""
        return dataclasses.replace(self, observation=self.observation.with_residual(residual))

    def in_frame(self, frame: EffectiveGravityFrame) -> "AbstractTrack":
        """Return the task with the reference in ``frame``."""
        observation = self.observation.in_frame(frame)
        return dataclasses.replace(self, reference=self.reference.in_frame(frame), observation=observation)


@eqx.filter_jit
def _start(reference: AbstractReference) -> Float[Array, "3"]:
    return reference(jnp.array(0.0)).p


class Track(AbstractTrack):
    """Tracking with the paper's reward."""

    def reward(self, t: Float[Array, ""], x: State, u: Command) -> Float[Array, ""]:
        """Return -L_H(p - p_ref) - L_H(v - v_ref) - 0.1 L_H(u - u_hover)."""
        here = self.reference(t)
        return -huber(x.p - here.p) - huber(x.v - here.v) - 0.1 * huber(u.vector() - Command.hover().vector())


class L2Track(AbstractTrack):
    """Tracking with a reward that is five times as steep in position and centred on the reference's own command.

    The paper's reward accepts centimetres of error in exchange for less tilt, even without a disturbance.
    """

    def reward(self, t: Float[Array, ""], x: State, u: Command) -> Float[Array, ""]:
        """Return -L_H(5 (p - p_ref)) - L_H(v - v_ref) - 0.1 L_H(u - u_ref) - 0.5 (1 - cos of the heading error)."""
        return self._reward(self.reference(t), x, u)

    def _reward(self, here: Point, x: State, u: Command) -> Float[Array, ""]:
        heading = jnp.stack([jnp.cos(here.heading), jnp.sin(here.heading)])
        astray = 1.0 - jnp.sum(heading * x.R[:2, 0])
        return -huber(5.0 * (x.p - here.p)) - huber(x.v - here.v) - 0.1 * huber(u.vector() - here.u) - 0.5 * astray


class SharpTrack(L2Track):
    """Tracking with a reward that also has a tip at the reference, since a quadratic reward is flat near zero."""

    def reward(self, t: Float[Array, ""], x: State, u: Command) -> Float[Array, ""]:
        """Return the reward of :class:`L2Track` minus 3 (sqrt(|p - p_ref|^2 + (1 cm)^2) - 1 cm)."""
        here = self.reference(t)
        tip = jnp.sqrt(jnp.sum((x.p - here.p) ** 2) + 0.01**2) - 0.01
        return self._reward(here, x, u) - 3.0 * tip


class ExactTrack(AbstractTrack):
    """Tracking with a reward that contains only the errors, with a tip at the reference.

    The command of the reference is not part of it: with drag, a fast path needs a different one.
    """

    def reward(self, t: Float[Array, ""], x: State, u: Command) -> Float[Array, ""]:
        """Return -L_H(5 (p - p_ref)) - L_H(v - v_ref) - 3 (sqrt(|p - p_ref|^2 + (1 cm)^2) - 1 cm)."""
        del u
        here = self.reference(t)
        tip = jnp.sqrt(jnp.sum((x.p - here.p) ** 2) + 0.01**2) - 0.01
        return -huber(5.0 * (x.p - here.p)) - huber(x.v - here.v) - 3.0 * tip
