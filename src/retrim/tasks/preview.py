"""Observation of a tracking policy: the reference relative to the vehicle, now and up to 0.4 s ahead."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..physics.effective_gravity import EffectiveGravityFrame
from ..physics.state import Command, State
from .abstract_reference import AbstractReference
from .observation import VELOCITY_SCALE, AbstractObservation, with_command

POSITIONS = (0.0, 0.08, 0.16, 0.28, 0.4)  # [s] ahead
VELOCITIES = (0.0, 0.2)
ACCELERATION_SCALE = 10.0  # [m/s^2]
JERK_SCALE = 20.0  # [m/s^3]


class Preview(AbstractObservation[Float[Array, "history 4"]]):
    """o = [p_ref(t + 0 ... 0.4 s) - p, v_ref(t, t + 0.2 s) - v, R, v, heading, last commands].

    The observation does not contain the absolute position, so one policy can fly the same shape anywhere. Every
    entry is scaled to order one.
    """

    reference: AbstractReference
    omega_max: Float[Array, "3"]
    history: int = eqx.field(static=True, default=2)
    accelerations: tuple[float, ...] = eqx.field(static=True, default=())
    """Times ahead at which the reference's acceleration and jerk are also observed [s]."""

    @property
    def size(self) -> int:
        """Length of the observation: 35 + 4 ``history``, plus 6 for each entry of ``accelerations``."""
        return 3 * len(POSITIONS) + 3 * len(VELOCITIES) + 6 * len(self.accelerations) + 9 + 3 + 2 + 4 * self.history

    def init(self, x: State) -> Float[Array, "history 4"]:
        """Return the memory of a vehicle that has hovered until now."""
        return jnp.zeros((self.history, 4), dtype=x.p.dtype)

    def __call__(
        self, memory: Float[Array, "history 4"], t: Float[Array, ""], x: State, last: Command
    ) -> tuple[Float[Array, " o"], Float[Array, "history 4"]]:
        """Return the reference relative to the vehicle, in world axes, with attitude, velocity and commands."""
        memory = with_command(memory, last, self.omega_max)
        # Evaluate all instants at once, since each separate evaluation of a reference would be compiled again.
        first, second = len(POSITIONS), len(POSITIONS) + len(VELOCITIES)
        ahead = jax.vmap(self.reference)(t + jnp.array((*POSITIONS, *VELOCITIES, *self.accelerations), dtype=t.dtype))
        heading = ahead.heading[0]
        parts = [
            (ahead.p[:first] - x.p[None]).reshape(-1),
            (ahead.v[first:second] - x.v[None]).reshape(-1) / VELOCITY_SCALE,
            x.R.reshape(9),
            x.v / VELOCITY_SCALE,
            jnp.stack([jnp.cos(heading), jnp.sin(heading)]),
            memory.reshape(-1),
            (ahead.a[second:] / ACCELERATION_SCALE).reshape(-1),
            (ahead.jerk[second:] / JERK_SCALE).reshape(-1),
        ]
        return jnp.concatenate(parts), memory

    def in_frame(self, frame: EffectiveGravityFrame) -> "Preview":
        """Return the observation of the reference in ``frame``."""
        return Preview(self.reference.in_frame(frame), self.omega_max, self.history, self.accelerations)
