"""The environment of training: a model, a task and a command delay as one value."""

import dataclasses
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from ..physics.dynamics import AbstractDynamics, Hybrid, Residual
from ..physics.felt_frame import FeltFrame
from ..physics.state import Command, State
from ..tasks.task import AbstractTask


class Env(eqx.Module):
    """Where a policy is trained and judged: one drone, one model, one task."""

    dynamics: AbstractDynamics[Any]
    """Model of the vehicle; it ticks at the task's rate."""
    task: AbstractTask
    delay_ticks: int = eqx.field(static=True, default=0)
    """A command issued at a tick acts this many ticks later."""
    felt: Residual | None = None
    """The disturbance that a controller around the policy answers by the frame of the gravity that is felt, given the
    state and the last command, world [m/s^2]; None if the policy sees the world as it is."""
    jump_cost: Float[Array, ""] | None = None
    """Cost of the squared change of a policy's command from tick to tick, [c, omega] in m/s^2 and rad/s; None: none."""

    def __check_init__(self) -> None:
        """Raise ``ValueError`` for a negative delay, and for a model and a task that tick at different rates."""
        if self.delay_ticks < 0:
            raise ValueError(f"Env.delay_ticks = {self.delay_ticks} must not be negative")
        if self.dynamics.dt != self.task.dt:
            raise ValueError(f"Env: the model ticks every {self.dynamics.dt} s, the task every {self.task.dt} s")

    def with_residual(self, residual: Residual) -> "Env":
        """Return the same environment with ``residual`` added to its model, without gradients through it."""
        return dataclasses.replace(self, dynamics=Hybrid(self.dynamics, residual))

    def frame(self, x: State, last: Command) -> FeltFrame | None:
        """Return the frame in which the policy sees the world, without gradients through it; None for the world's own.

        Args:
            x: State.
            last: Command issued one tick ago.
        """
        return None if self.felt is None else FeltFrame.of(lax.stop_gradient(self.felt(x, last)))

    def cost_of_jump(self, before: Command, after: Command) -> Float[Array, ""]:
        """Return what it costs that the policy commands ``after`` a tick after it commanded ``before``."""
        if self.jump_cost is None:
            return jnp.zeros_like(after.c)
        return self.jump_cost * jnp.sum((after.vector() - before.vector()) ** 2)
