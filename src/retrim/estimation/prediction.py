"""Predict the state at the time when the next command begins to act."""

import dataclasses
import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..physics.actuator_response import FASTEST, ActuatorState
from ..physics.command_path import ROUNDING, CommandPath, CommandQueue
from ..physics.dynamics import runge_kutta
from ..physics.state import Command, State
from .latency import ahead


class Underway(eqx.Module):
    """Commands in transit to a vehicle, and the state of its actuators."""

    before: ActuatorState
    """State of the actuators at the beginning of the tick that has just ended."""
    queue: CommandQueue
    """Commands of the last few ticks; the newest was issued for the tick that has just ended."""


class Prediction(eqx.Module):
    """Prediction with a vehicle's declared command path, followed by Eq. (1) of the paper."""

    path: CommandPath
    dt: float = eqx.field(static=True)
    """Control tick [s]."""
    ticks: int = eqx.field(static=True)
    """Delay of the path in ticks, rounded up; a static number, since most vehicles need only one prediction step."""
    age: Float[Array, ""] = eqx.field(default_factory=lambda: jnp.array(0.0))
    """Age of measurements [s]."""

    @classmethod
    def of(cls, path: CommandPath, dt: float) -> "Prediction":
        """Return the prediction for a command path.

        Args:
            path: Declared command path.
            dt: Control tick [s].
        """
        return cls(path, dt, math.ceil(float(path.delay) / dt - ROUNDING))

    def with_age(self, age: float | Float[Array, ""]) -> "Prediction":
        """Return the same prediction for measurements that are ``age`` old [s]."""
        return dataclasses.replace(self, age=jnp.array(age))

    def init(self, x: State) -> Underway:
        """Return the memory of a vehicle that has hovered until now."""
        hover = Command.hover(x.p.dtype)
        return Underway(ActuatorState.at(hover), CommandQueue.of(hover, self.dt, longest=self.ticks * self.dt))

    def acting(self, s: Underway) -> tuple[Command, ActuatorState]:
        """Return the mean thrust and rates over the tick that has just ended, and the actuator state at its end."""
        return self.path.advance(s.queue, s.before, self.dt)

    def thrust(self, s: Underway, before: Float[Array, "3 3"], after: Float[Array, "3 3"]) -> Float[Array, "3"]:
        """Return the mass-normalised thrust over the tick that has just ended, in the world frame [m/s^2].

        Args:
            s: Memory.
            before: Attitude at the beginning of the tick, body to world.
            after: Attitude at the end of the tick.
        """
        return self.acting(s)[0].c * 0.5 * (before[:, 2] + after[:, 2])

    def __call__(
        self, s: Underway, x: State, d: Float[Array, "3"], omega: Float[Array, "3"] | None = None
    ) -> tuple[State, Command]:
        """Return the state and the acting command at the time when a command that is issued now begins to act.

        Args:
            s: Memory.
            x: Measured state.
            d: Disturbance, world [m/s^2].
            omega: Measured body rates [rad/s]; None to use the rates that follow from the commands.
        """
        _, actuators = self.acting(s)
        if omega is not None:
            actuators = dataclasses.replace(actuators, command=Command(actuators.command.c, omega))
        x = ahead(x, actuators.command, d, self.age.astype(x.p.dtype))
        delay, response = self.path.delay.astype(x.p.dtype), self.path.response
        for back in range(self.ticks, 0, -1):  # ticks since the command was issued
            u: Command = jax.tree.map(lambda leaf, at=-back: leaf[at], s.queue.commands)
            h = jnp.clip(delay - (back - 1) * self.dt, 0.0, self.dt)
            away, actuators = response(actuators, u, h)
            over = jnp.maximum(h, FASTEST)
            mean = jax.tree.map(lambda target, each, over=over: target + each / over, response.target(u), away)
            x = runge_kutta(x, mean, d, h)
        return x, actuators.command

    def issue(self, s: Underway, u: Command) -> Underway:
        """Return the memory after the command ``u`` was issued for the tick that begins now."""
        return Underway(self.acting(s)[1], s.queue.push(u))

    def accept(self, s: Underway, u: Command) -> Underway:
        """Return the memory after the plant accepted ``u`` instead of the command that was issued last."""
        return Underway(s.before, s.queue.amend(u))
