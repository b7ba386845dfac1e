"""Disturbance observer: the acceleration that the nominal model misses, low-passed, from states and commands."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..physics.dynamics import AbstractDynamics
from ..physics.state import Command, State


class ObserverState(eqx.Module):
    """Memory of the observer."""

    last: State
    """State one tick ago."""
    commands: tuple[Command, ...]
    """Commands of the last ticks, oldest first; the oldest acted during the tick that has just ended."""
    d_hat: Float[Array, "3"]
    """Estimated disturbance acceleration, world [m/s^2]."""


class DisturbanceObserver(eqx.Module):
    """First-order low-pass of a_gt - a_hat: the difference of velocity over a tick against the nominal model's."""

    nominal: AbstractDynamics[Any]
    tau: Float[Array, ""]
    """Time constant of the filter [s]."""
    limit: Float[Array, ""]
    """Largest norm of the estimate [m/s^2]."""
    delay_ticks: int = eqx.field(static=True, default=0)
    """Declared command delay of the plant [ticks]."""

    def init(self, x: State) -> ObserverState:
        """Return the memory of a vehicle that hovers at ``x`` undisturbed."""
        return ObserverState(x, (Command.hover(),) * (self.delay_ticks + 1), jnp.zeros_like(x.p))

    def __call__(self, s: ObserverState, x: State) -> ObserverState:
        """Return the memory with the estimate corrected by the newly measured state ``x``.

        Call it once per tick, then :meth:`issued` with the command of the new tick.
        """
        nominal = self.nominal
        expected = nominal.state(nominal.step(nominal.init(s.last), s.commands[0], jnp.zeros_like(x.p)))
        missed = (x.v - expected.v) / nominal.dt
        d_hat = s.d_hat + (1.0 - jnp.exp(-nominal.dt / self.tau)) * (missed - s.d_hat)
        norm = jnp.sqrt(jnp.sum(d_hat * d_hat) + 1e-12)
        return ObserverState(x, s.commands, d_hat * jnp.minimum(1.0, self.limit / norm))

    def issued(self, s: ObserverState, u: Command) -> ObserverState:
        """Return the memory after the command ``u`` was issued for the tick that begins."""
        return ObserverState(s.last, (*s.commands[1:], u), s.d_hat)
