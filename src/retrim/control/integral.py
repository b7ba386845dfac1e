"""Add integral action on the position to an unchanged policy, as the baseline for learning in hover."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..physics.state import Command, State
from ..tasks.task import AbstractTask
from .wrapped_controller import WrappedController


class IntegralState(eqx.Module):
    """Integral of the position error, and the memory of the inner controller."""

    integral: Float[Array, "3"]
    """Integral of the position error [m s]."""
    inner: Any


class IntegralAction(WrappedController[IntegralState]):
    """Passes the position p + gain * integral of (p - target) to a controller."""

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

    def accept(self, memory: IntegralState, u: Command) -> IntegralState:
        """Pass the accepted command to the inner controller."""
        return IntegralState(memory.integral, self.inner.accept(memory.inner, u))
