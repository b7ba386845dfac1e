"""The geometric tracking controller: position, velocity and attitude feedback around a reference (Lee et al. 2010)."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..estimation.prediction import Prediction, Underway
from ..physics.state import Command, State
from ..tasks.abstract_reference import Point
from ..tasks.task import AbstractTask
from .attitude import command_for, thrust_of
from .controller import AbstractController


class Gains(eqx.Module):
    """Gains of a controller with three loops."""

    position: Float[Array, ""]
    """Gain of the position error [1/s^2]."""
    velocity: Float[Array, ""]
    """Gain of the velocity error [1/s]."""
    attitude: Float[Array, ""]
    """Gain of the attitude error [1/s]."""
    integral: Float[Array, ""]
    """Gain of the integral of the position error [1/s^3]; zero disables integral action."""

    def acceleration(self, x: State, setpoint: Point, integral: Float[Array, "3"]) -> Float[Array, "3"]:
        """Return the acceleration that brings a vehicle to its reference, in the world frame [m/s^2].

        Args:
            x: State.
            setpoint: Reference.
            integral: Integral of the position error [m s].
        """
        back = self.position * (setpoint.p - x.p) + self.velocity * (setpoint.v - x.v)
        return setpoint.a + back + self.integral * integral

    def turning(self) -> Float[Array, "3"]:
        """Return the attitude gain about each body axis [1/s]; a quadrotor turns slowly about its thrust axis."""
        return self.attitude * jnp.array([1.0, 1.0, 0.4], dtype=self.attitude.dtype)


class GeometricState(eqx.Module):
    """Memory of the controller."""

    underway: Underway
    integral: Float[Array, "3"]
    """Integral of the position error [m s]."""


class GeometricController(AbstractController[GeometricState]):
    """Geometric tracking, with integral action if its gain is not zero."""

    task: AbstractTask
    """Task, which provides the reference."""
    gains: Gains
    prediction: Prediction
    limit: Float[Array, ""]
    """Largest acceleration from integral action, per axis [m/s^2]."""
    low: Command
    """Smallest command that the vehicle accepts."""
    high: Command
    """Largest command that the vehicle accepts."""

    def with_age(self, age: float | Float[Array, ""]) -> "GeometricController":
        """Return the same controller for measurements that are ``age`` seconds old."""
        return dataclasses.replace(self, prediction=self.prediction.with_age(age))

    def disturbance(self, memory: GeometricState, x: State, u: Command) -> Float[Array, "3"]:
        """Return the acceleration that the integral action compensates."""
        del x, u
        return -self.gains.integral * memory.integral

    def init(self, x: State) -> GeometricState:
        """Return the memory at the start of a flight."""
        return GeometricState(self.prediction.init(x), jnp.zeros_like(x.p))

    def __call__(self, memory: GeometricState, t: Float[Array, ""], x: State) -> tuple[Command, GeometricState]:
        """Compute the command for the state in which the command begins to act."""
        gain, dt = self.gains.integral, self.prediction.dt
        x, _ = self.prediction(memory.underway, x, gain * -memory.integral)
        setpoint = self.task.setpoint(t + self.prediction.path.delay.astype(t.dtype))
        bound = self.limit / jnp.maximum(gain, 1e-6)
        integral = jnp.clip(memory.integral + dt * (setpoint.p - x.p), -bound, bound)
        acceleration = self.gains.acceleration(x, setpoint, integral)
        u = command_for(x, thrust_of(acceleration), setpoint, self.gains.turning()).within(self.low, self.high)
        return u, GeometricState(self.prediction.issue(memory.underway, u), integral)

    def accept(self, memory: GeometricState, u: Command) -> GeometricState:
        """Remember the accepted command."""
        return GeometricState(self.prediction.accept(memory.underway, u), memory.integral)
