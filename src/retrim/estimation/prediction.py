"""Prediction of the state at the time when the next command begins to act."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..physics.actuators import lagged
from ..physics.dynamics import PointMass
from ..physics.state import Command, State
from .latency import ahead


class Underway(eqx.Module):
    """Commands under way to a vehicle, and the state of its actuators."""

    before: Command
    """Command that acted at the beginning of the tick that has just ended, after the actuator lag."""
    commands: tuple[Command, ...]
    """Commands of the last ticks, oldest first; the oldest acted during the tick that has just ended."""


class Prediction(eqx.Module):
    """Eq. (1) of the paper with the declared actuator lag and command delay of a vehicle."""

    tau: Float[Array, ""]
    """Time constant of the actuators [s]."""
    dt: float = eqx.field(static=True)
    """Control tick [s]."""
    delay_ticks: int = eqx.field(static=True, default=0)
    """Declared command delay [ticks]."""
    age: Float[Array, ""] = eqx.field(default_factory=lambda: jnp.array(0.0))
    """Age of measurements [s]."""

    def with_age(self, age: float | Float[Array, ""]) -> "Prediction":
        """Return the same for measurements that are ``age`` old [s]."""
        return dataclasses.replace(self, age=jnp.array(age))

    def init(self, x: State) -> Underway:
        """Return the memory of a vehicle that has hovered until now."""
        hover = Command.hover(x.p.dtype)
        return Underway(hover, (hover,) * (self.delay_ticks + 1))

    def acted(self, s: Underway) -> tuple[Command, Command]:
        """Return the mean command that acted over the tick that has just ended, and the one that acts at its end."""
        return lagged(s.before, s.commands[0], self.dt, self.tau.astype(s.before.c.dtype))

    def thrust(self, s: Underway, before: Float[Array, "3 3"], after: Float[Array, "3 3"]) -> Float[Array, "3"]:
        """Return the mass-normalised thrust over the tick that has just ended, world [m/s^2].

        Args:
            s: Memory.
            before: Attitude at the beginning of the tick, body to world.
            after: Attitude at the end of the tick.
        """
        return self.acted(s)[0].c * 0.5 * (before[:, 2] + after[:, 2])

    def __call__(
        self, s: Underway, x: State, d: Float[Array, "3"], omega: Float[Array, "3"] | None = None
    ) -> tuple[State, Command]:
        """Return the state and the acting command at the time when a command that is issued now begins to act.

        Args:
            s: Memory.
            x: Measured state.
            d: Disturbance, world [m/s^2].
            omega: Measured body rates [rad/s]; None for those that follow from the commands.
        """
        _, acting = self.acted(s)
        if omega is not None:
            acting = Command(acting.c, omega)
        x = ahead(x, acting, d, self.age.astype(x.p.dtype))
        for u in s.commands[1:]:
            mean, acting = lagged(acting, u, self.dt, self.tau.astype(x.p.dtype))
            x = PointMass(self.dt).step(x, mean, d)
        return x, acting

    def issued(self, s: Underway, u: Command) -> Underway:
        """Return the memory after the command ``u`` was issued for the tick that begins."""
        return Underway(self.acted(s)[1], (*s.commands[1:], u))

    def accepted(self, s: Underway, u: Command) -> Underway:
        """Return the memory after the plant accepted ``u`` instead of the command that was issued last."""
        return Underway(s.before, (*s.commands[:-1], u))
