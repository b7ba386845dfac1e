"""Add integral action on the position to an unchanged policy, as the baseline for learning in hover."""

import dataclasses
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..physics.actuator_response import ActuatorState
from ..physics.path_family import Member
from ..physics.state import Command, State
from ..tasks.task import AbstractTask
from .controller import AbstractController


class IntegralState(eqx.Module):
    """Integral of the position error, and the memory of the inner controller."""

    integral: Float[Array, "3"]
    """Integral of the position error [m s]."""
    inner: Any


class IntegralAction(AbstractController[IntegralState]):
    """Passes the position p + gain * integral of (p - target) to a controller."""

    inner: AbstractController[Any]
    task: AbstractTask
    """Task, which provides the target."""
    gain: Float[Array, ""]
    """Gain of the integral [1/s]."""
    limit: Float[Array, ""]
    """Limit of the integral per axis [m s]."""

    def init(self, x: State) -> IntegralState:
        """Return the memory at the start of a flight, with an integral of zero."""
        return IntegralState(jnp.zeros_like(x.p), self.inner.init(x))

    def __call__(self, memory: IntegralState, t: Float[Array, ""], x: State) -> tuple[Command, IntegralState]:
        """Integrate one tick, and return the command of the controller for the shifted position."""
        new_integral = memory.integral + self.task.dt * (x.p - self.task.target(t))
        integral = jnp.clip(new_integral, -self.limit, self.limit)
        u, inner = self.inner(memory.inner, t, State(x.p + self.gain * integral, x.R, x.v))
        return u, IntegralState(integral, inner)

    def disturbance(self, memory: IntegralState, x: State, u: Command) -> Float[Array, "3"]:
        """Return the disturbance that the inner controller expects."""
        return self.inner.disturbance(memory.inner, x, u)

    def accept(self, memory: IntegralState, u: Command) -> IntegralState:
        """Pass the accepted command to the inner controller."""
        return IntegralState(memory.integral, self.inner.accept(memory.inner, u))

    def with_vehicle(self, member: Member) -> "IntegralAction":
        """Return the same controller for an identified vehicle."""
        return dataclasses.replace(self, inner=self.inner.with_vehicle(member))

    def with_actuators(self, actuators: ActuatorState) -> "IntegralAction":
        """Return the same controller for a tick in which thrust and body rates are known."""
        return dataclasses.replace(self, inner=self.inner.with_actuators(actuators))
