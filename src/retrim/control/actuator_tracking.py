"""Track thrust and body rates in flight, for a policy that observes them."""

import dataclasses
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..estimation.body_rates import BodyRates
from ..physics.command_path import CommandPath
from ..physics.path_family import Member
from ..physics.state import Command, State
from .wrapped_controller import WrappedController


class TrackingState(eqx.Module):
    """Memory of the tracking and of the inner controller."""

    rates: BodyRates
    inner: Any


class ActuatorTracking(WrappedController[TrackingState]):
    """Provides the inner controller with the present thrust and body rates.

    The command path predicts thrust and body rates. A gyroscope, or the measured attitudes, corrects the body rates.
    """

    path: CommandPath
    """Known command path of the vehicle."""
    dt: float = eqx.field(static=True)
    """Control tick [s]."""
    omega: Float[Array, "3"] | None = None
    """Measured body rates [rad/s]; None if they are not measured."""
    age: Float[Array, ""] = eqx.field(default_factory=lambda: jnp.array(0.0))
    """Age of measurements [s]."""

    def with_age(self, age: float | Float[Array, ""]) -> "ActuatorTracking":
        """Return the same controller for measurements that are ``age`` seconds old."""
        return dataclasses.replace(super().with_age(age), age=jnp.array(age))

    def with_inertial(self, omega: Float[Array, "3"], a: Float[Array, "3"]) -> "ActuatorTracking":
        """Return the same controller for a tick in which body rates and acceleration were measured."""
        return dataclasses.replace(super().with_inertial(omega, a), omega=omega)

    def with_vehicle(self, member: Member) -> "ActuatorTracking":
        """Return the same controller for an identified vehicle."""
        return dataclasses.replace(super().with_vehicle(member), path=member.path)

    def init(self, x: State) -> TrackingState:
        """Return the memory at the start of a flight."""
        return TrackingState(BodyRates.start(x, self.dt), self.inner.init(x))

    def __call__(self, memory: TrackingState, t: Float[Array, ""], x: State) -> tuple[Command, TrackingState]:
        """Return the command of the inner controller, which receives the present thrust and body rates."""
        rates = memory.rates.observe(x, self.age, self.path, self.dt, self.omega)
        u, inner = self.inner.with_actuators(rates.path.actuators)(memory.inner, t, x)
        return u, TrackingState(rates.issue(u, self.path, self.dt), inner)

    def accept(self, memory: TrackingState, u: Command) -> TrackingState:
        """Remember the accepted command."""
        return TrackingState(memory.rates.accept(u, self.path, self.dt), self.inner.accept(memory.inner, u))
