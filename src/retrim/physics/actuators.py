"""Actuators in front of any model. Without them, a steep reward yields gains that slow motors cannot follow."""

import dataclasses
from typing import Any, Generic, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .actuator_response import ActuatorResponse, ActuatorState
from .dynamics import AbstractDynamics, AbstractWrapper
from .state import Command, State

AT_LIMIT = 0.05  # a command this share of its range from a limit, or less, is at it

X = TypeVar("X")
U = TypeVar("U")


class LagState(eqx.Module, Generic[X]):
    """State of the model, and of the actuators in front of it."""

    inner: X
    actuators: ActuatorState


def lagged(acting: U, u: U, dt: float, tau: Float[Array, ""] | Command) -> tuple[U, U]:
    """Return what a first-order lag makes of a command over a tick.

    Args:
        acting: Command at the actuators at the beginning of the tick; or arrays of commands.
        u: Command that reaches them, of the same kind.
        dt: Length of the tick [s].
        tau: Time constant [s], of all parts alike, or of each part of a command.

    Returns:
        The mean over the tick, and what acts at its end.
    """
    taus: Any = tau if isinstance(tau, Command) else jax.tree.map(lambda _: tau, u)
    decay = jax.tree.map(lambda each: jnp.exp(-dt / each), taus)
    # Share of the old command in the mean over the tick.
    left = jax.tree.map(lambda each, kept: each / dt * (1.0 - kept), taus, decay)
    mean, end = (
        jax.tree.map(lambda old, new, share: new + share * (old - new), acting, u, shares) for shares in (left, decay)
    )
    return mean, end


def is_followed(u: Command, limits: tuple[Command, Command]) -> Bool[Array, ""]:
    """Return whether no part of a command is at a limit, where vehicles do something else.

    At the least thrust, for example, a mixer adds thrust to turn as fast as it is told.

    Args:
        u: Command.
        limits: Smallest and largest command.
    """
    low, high, asked = (jnp.concatenate([each.c[None], each.omega]) for each in (*limits, u))
    inside = jnp.abs(asked - 0.5 * (low + high)) < (0.5 - AT_LIMIT) * (high - low)
    return jnp.all(inside)


class RateBiased(AbstractWrapper[X]):
    """The vehicle turns faster than it is told, by a constant."""

    base: AbstractDynamics[X]
    bias: Float[Array, "3"]
    """Body frame [rad/s]."""

    def step(self, s: X, u: Command, a_ext: Float[Array, "3"]) -> X:
        """Advance the base model by one tick under the rates that the vehicle turns at."""
        return self.base.step(s, Command(u.c, u.omega + self.bias), a_ext)


class Lagged(AbstractDynamics[LagState[X]]):
    """A model behind the response of actuators and rate loop."""

    base: AbstractDynamics[X]
    response: ActuatorResponse

    @property
    def dt(self) -> float:
        """Control tick of the base model [s]."""
        return self.base.dt

    @property
    def settling_ticks(self) -> Float[Array, ""]:
        """Settling time of the response, on top of that of the base model [ticks]."""
        # Ticks that are whole but for rounding are whole.
        return jnp.ceil(self.response.settling_time / self.dt - 0.01) + self.base.settling_ticks

    def init(self, x: State) -> LagState[X]:
        """Lift to the base model's state, with the actuators at hover."""
        return LagState(self.base.init(x), ActuatorState.at(Command.hover(x.p.dtype)))

    def state(self, s: LagState[X]) -> State:
        """Return the vehicle's state."""
        return self.base.state(s.inner)

    def with_state(self, s: LagState[X], x: State) -> LagState[X]:
        """Replace (p, R, v); hidden state stays."""
        return LagState(self.base.with_state(s.inner, x), s.actuators)

    def actuators(self, s: LagState[X]) -> ActuatorState:
        """Return the present thrust and body rates."""
        return s.actuators

    def step(self, s: LagState[X], u: Command, a_ext: Float[Array, "3"]) -> LagState[X]:
        """Advance one tick under the mean of what acts over it."""
        away, actuators = self.response(s.actuators, u, self.dt)
        mean = jax.tree.map(lambda target, each: target + each / self.dt, self.response.target(u), away)
        return LagState(self.base.step(s.inner, mean, a_ext), actuators)


def with_response(model: AbstractDynamics[Any], response: ActuatorResponse) -> AbstractDynamics[Any]:
    """Return a model whose actuators respond in another way; one without actuators is put behind them.

    Args:
        model: A model, or wrappers around one.
        response: Of thrust and body rates.
    """
    if isinstance(model, Lagged):
        return Lagged(model.base, response)
    if isinstance(model, AbstractWrapper):
        return dataclasses.replace(model, base=with_response(model.base, response))
    return Lagged(model, response)
