"""Incremental nonlinear dynamic inversion (INDI), which corrects the acting thrust by the acceleration error.

The measured acceleration contains every disturbance, so a disturbance model is not needed: the desired thrust is f +
(a_wanted - a). The acting thrust f and the acceleration a pass through the same filter, so that they belong to the same
time (Smeur, de Croon and Chu 2018; Tal and Karaman 2021, here above the body-rate loop).
"""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..estimation.latency import follows
from ..estimation.prediction import Prediction, Underway
from ..physics import so3
from ..physics.state import Command, State
from ..tasks.task import AbstractTask
from .attitude import command_for, thrust_of
from .controller import AbstractController
from .geometric import Gains


class IncrementalState(eqx.Module):
    """Memory of the controller."""

    underway: Underway
    last: State
    """State measured one tick ago."""
    excess: Float[Array, "3"]
    """Filtered difference between the acting thrust and the thrust that explains the measured acceleration, world
    [m/s^2]."""
    t: Float[Array, ""]
    """Time of the last measurement [s]; minus infinity before the first measurement."""


class IndiController(AbstractController[IncrementalState]):
    """INDI at the level of the thrust vector."""

    task: AbstractTask
    """Task, which provides the reference."""
    gains: Gains
    prediction: Prediction
    tau: Float[Array, ""]
    """Time constant of the filter for acceleration and thrust [s]."""
    low: Command
    """Smallest command that the vehicle accepts."""
    high: Command
    """Largest command that the vehicle accepts."""
    omega: Float[Array, "3"] | None = None
    """Measured body rates [rad/s]; None to derive them from the commands."""
    a: Float[Array, "3"] | None = None
    """Mean measured acceleration over the last tick, in the world frame [m/s^2]; None to derive it from velocities."""

    def with_age(self, age: float | Float[Array, ""]) -> "IndiController":
        """Return the same controller for measurements that are ``age`` seconds old."""
        return dataclasses.replace(self, prediction=self.prediction.with_age(age))

    def with_inertial(self, omega: Float[Array, "3"], a: Float[Array, "3"]) -> "IndiController":
        """Return the same controller for a tick in which body rates and acceleration were measured."""
        return dataclasses.replace(self, omega=omega, a=a)

    def disturbance(self, memory: IncrementalState, x: State, u: Command) -> Float[Array, "3"]:
        """Return the acceleration that the acting thrust does not explain."""
        del x, u
        return -memory.excess

    def init(self, x: State) -> IncrementalState:
        """Return the memory at the start of a flight."""
        return IncrementalState(self.prediction.init(x), x, jnp.zeros_like(x.p), jnp.full_like(x.p[0], -jnp.inf))

    def __call__(self, memory: IncrementalState, t: Float[Array, ""], x: State) -> tuple[Command, IncrementalState]:
        """Compute the command for the state in which the command begins to act."""
        dt, last = self.prediction.dt, memory.last
        mean_command, _ = self.prediction.acting(memory.underway)
        a = (x.v - last.v) / dt if self.a is None else self.a
        # The accelerometer does not have latency, even if the attitude does.
        late = self.prediction.age if self.a is not None else jnp.zeros_like(self.prediction.age)
        attitude_change = so3.exp(late.astype(a.dtype) * (mean_command.omega if self.omega is None else self.omega))
        thrust = self.prediction.thrust(
            memory.underway, so3.mul(last.R, attitude_change), so3.mul(x.R, attitude_change)
        )
        share = jnp.where(follows(t, memory.t, dt), 1.0 - jnp.exp(-dt / self.tau.astype(a.dtype)), 0.0)
        excess = memory.excess + share * (thrust - thrust_of(a) - memory.excess)
        soon, _ = self.prediction(memory.underway, x, -excess, self.omega)
        setpoint = self.task.setpoint(t + self.prediction.path.delay.astype(t.dtype))
        acceleration = self.gains.acceleration(soon, setpoint, jnp.zeros_like(x.p))
        command = command_for(soon, thrust_of(acceleration) + excess, setpoint, self.gains.turning())
        u = command.within(self.low, self.high)
        return u, IncrementalState(self.prediction.issue(memory.underway, u), x, excess, t.astype(a.dtype))

    def accept(self, memory: IncrementalState, u: Command) -> IncrementalState:
        """Remember the accepted command."""
        return dataclasses.replace(memory, underway=self.prediction.accept(memory.underway, u))
