"""Stabilising hover at a goal (paper, Sec. IV-A.1)."""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import random
from jaxtyping import Array, Bool, Float, Key

from ..physics import so3
from ..physics.state import Command, State
from .observation import AbstractObservation
from .task import AbstractTask, Start, huber

TILT = 0.1 * math.pi  # [rad], 18 degrees


class Hover(AbstractTask):
    """Fly to ``goal`` and stay.

    A vehicle farther than ``box`` [m] from the goal along any axis is lost. The box is wide, since in a tight one a
    strong disturbance ends every flight and leaves nothing to learn from.
    """

    goal: Float[Array, "3"]
    observation: AbstractObservation[Any]
    box: Float[Array, ""]
    heading: Float[Array, ""]
    """Starts head within +- this angle of the x axis [rad]; pi for anywhere."""
    dt: float = eqx.field(static=True, default=0.02)
    horizon: int = eqx.field(static=True, default=150)

    def reset(self, key: Key[Array, ""]) -> Start:
        """Goal +- 1 m per axis, yaw within ``heading``, pitch and roll within 18 degrees, 0.1 m/s of velocity noise."""
        kp, ka, kv = random.split(key, 3)
        p = self.goal + random.uniform(kp, (3,), minval=-1.0, maxval=1.0)
        roll, pitch, turn = random.uniform(ka, (3,), minval=-1.0, maxval=1.0)
        R = so3.rotx(TILT * roll) @ so3.roty(TILT * pitch) @ so3.rotz(self.heading * turn)
        return Start(jnp.zeros_like(p[0]), State(p, R, 0.1 * random.normal(kv, (3,))))

    def reward(self, t: Float[Array, ""], x: State, u: Command) -> Float[Array, ""]:
        """r_pos + r_vel + r_act of the paper. The rate term acts on the commanded body rates, which Eq. (1) obeys."""
        r_pos = -1.0 * huber(5.0 * (x.p - self.goal))
        r_vel = -0.1 * huber(x.v) - 0.1 * huber(u.omega)
        r_act = -0.5 * huber(u.vector() - Command.hover().vector())
        return r_pos + r_vel + r_act

    def alive(self, t: Float[Array, ""], x: State) -> Bool[Array, ""]:
        """Inside the box, and finite."""
        finite = jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(x)])
        inside: Bool[Array, ""] = jnp.all(jnp.abs(x.p - self.goal) <= self.box) & jnp.all(finite)
        return inside

    def error(self, t: Float[Array, ""], x: State) -> Float[Array, ""]:
        """Distance from the goal [m]."""
        return jnp.sqrt(jnp.sum((x.p - self.goal) ** 2))
