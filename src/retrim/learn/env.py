"""The training environment: a model, a task and a command path as one value."""

import dataclasses
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax import lax, random
from jaxtyping import Array, Float, Key

from ..physics.actuators import with_response
from ..physics.command_path import LONGEST_DELAY, CommandPath, check_delay
from ..physics.dynamics import AbstractDynamics, Hybrid, Residual
from ..physics.effective_gravity import EffectiveGravityFrame
from ..physics.path_family import PathFamily
from ..physics.state import Command, State
from ..tasks.task import AbstractTask, Start


class Env(eqx.Module):
    """Environment in which a policy is trained and judged: one drone, one model, one task."""

    dynamics: AbstractDynamics[Any]
    """Vehicle model; it has the same tick as the task."""
    task: AbstractTask
    delay: Float[Array, ""] = eqx.field(default_factory=lambda: jnp.zeros(()))
    """Transport delay of commands [s]. A new value does not trigger a recompilation."""
    frame_disturbance: Residual | None = None
    """Disturbance for which a controller around the policy compensates with the frame of the effective gravity. It is a
    function of the state and the last command, world [m/s^2]; None if the policy observes in the world frame."""
    jump_cost: Float[Array, ""] | None = None
    """Cost of the squared change of a policy's command from tick to tick, [c, omega] in m/s^2 and rad/s; None for no
    cost."""
    family: PathFamily | None = None
    """Family from which training draws vehicles, each with a belief about it; None for the model's vehicle."""
    longest_delay: float = eqx.field(static=True, default=LONGEST_DELAY)
    """Longest delay that the command queue of a roll-out can hold [s]."""

    def __check_init__(self) -> None:
        """Raise ``ValueError`` if the delay is invalid, or if the model and the task have different ticks.

        A traced delay, or an array of delays, is not checked.
        """
        check_delay(self.delay, self.longest_delay, "Env")
        if self.dynamics.dt != self.task.dt:
            raise ValueError(f"Env: the model ticks every {self.dynamics.dt} s, the task every {self.task.dt} s")

    def with_residual(self, residual: Residual) -> "Env":
        """Return the same environment with ``residual`` added to its model, without gradients through it."""
        return dataclasses.replace(self, dynamics=Hybrid(self.dynamics, residual))

    def with_path(self, path: CommandPath) -> "Env":
        """Return the same environment for a vehicle with a different command path.

        Args:
            path: Delay and actuator response of that vehicle.
        """
        return dataclasses.replace(self, dynamics=with_response(self.dynamics, path.response), delay=path.delay)

    def reset(self, key: Key[Array, ""]) -> Start:
        """Draw a training start, with a vehicle from the family if there is one; the key is consumed."""
        if self.family is None:
            return self.task.reset(key)
        k_start, k_member = random.split(key)
        return dataclasses.replace(self.task.reset(k_start), member=self.family.draw(k_member))

    def frame(self, x: State, last: Command) -> EffectiveGravityFrame | None:
        """Return the frame in which the policy observes, without gradients through it; None for the world frame.

        Args:
            x: State.
            last: Command issued one tick ago.
        """
        return (
            None
            if self.frame_disturbance is None
            else EffectiveGravityFrame.of(lax.stop_gradient(self.frame_disturbance(x, last)))
        )

    def cost_of_jump(self, before: Command, after: Command) -> Float[Array, ""]:
        """Return the cost of changing the policy's command from ``before`` to ``after`` in one tick."""
        if self.jump_cost is None:
            return jnp.zeros_like(after.c)
        return self.jump_cost * jnp.sum((after.vector() - before.vector()) ** 2)
