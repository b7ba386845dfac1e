"""What a measurement says of the moment when the next command begins to act."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..physics.actuators import lagged
from ..physics.dynamics import PointMass
from ..physics.state import Command, State
from .latency import ahead


class Underway(eqx.Module):
    """Commands that a vehicle has been given, and what its actuators have made of them."""

    before: Command
    """What acted at the beginning of the tick that has just ended."""
    commands: tuple[Command, ...]
    """Commands of the last ticks, oldest first; the oldest acted during the tick that has just ended."""


class Prediction(eqx.Module):
    """Eq. (1) of the paper with the actuator lag and the command delay that are declared of a vehicle."""

    tau: Float[Array, ""]
    """Time constant of the actuators [s]."""
    dt: float = eqx.field(static=True)
    """Control tick [s]."""
    delay_ticks: int = eqx.field(static=True, default=0)
    """Declared command delay [ticks]."""
    age: Float[Array, ""] = eqx.field(default_factory=lambda: jnp.array(0.0))
    """How old measurements are [s]."""

    def with_age(self, age: float | Float[Array, ""]) -> "Prediction":
        """Return the same for measurements that are ``age`` old [s]."""
        return dataclasses.replace(self, age=jnp.array(age))

    def init(self, x: State) -> Underway:
        """Return the memory of a vehicle that has hovered until now."""
        hover = Command.hover(x.p.dtype)
        return Underway(hover, (hover,) * (self.delay_ticks + 1))

    def acted(self, s: Underway) -> tuple[Command, Command]:
        """Return what acted over the tick that has just ended, in the mean, and what acts at its end."""
        return lagged(s.before, s.commands[0], self.dt, self.tau.astype(s.before.c.dtype))

    def thrust(self, s: Underway, before: Float[Array, "3 3"], after: Float[Array, "3 3"]) -> Float[Array, "3"]:
        """Return the mass-normalised thrust over the tick that has just ended, world [m/s^2].

        Args:
            s: Memory.
            before: Attitude at the beginning of the tick, body to world.
            after: Attitude at its end.
        """
        return self.acted(s)[0].c * 0.5 * (before[:, 2] + after[:, 2])

    def __call__(
        self, s: Underway, x: State, d: Float[Array, "3"], omega: Float[Array, "3"] | None = None
    ) -> tuple[State, Command]:
        """Return the state, and what acts, when a command that is issued now begins to act.

        Args:
            s: Memory.
            x: Measured state.
            d: Disturbance, world [m/s^2].
            omega: Measured body rates [rad/s], where they are; else they are those that the commands give.
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
