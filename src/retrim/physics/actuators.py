"""Place actuators in front of a model; without them, a steep reward leads to gains that slow motors cannot follow."""

import dataclasses
from typing import Any, Generic, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .actuator_response import ActuatorResponse, ActuatorState
from .dynamics import AbstractDynamics, AbstractWrapper
from .state import Command, State

LIMIT_SHARE = 0.05  # a command within this share of the range from a limit counts as being at the limit

X = TypeVar("X")
U = TypeVar("U")


class LagState(eqx.Module, Generic[X]):
    """State of the model and of the actuators in front of it."""

    inner: X
    actuators: ActuatorState


def apply_lag(acting: U, u: U, dt: float, tau: Float[Array, "*axes"] | Command) -> tuple[U, U]:
    """Return the output of a first-order lag for a command over a tick.

    Args:
        acting: Command, or arrays of commands, at the actuators at the beginning of the tick.
        u: Command that reaches the actuators, with the same structure as ``acting``.
        dt: Length of the tick [s].
        tau: Time constant [s]: one for all parts of a command, or one for each. An array is broadcast against
            arrays of commands.

    Returns:
        Mean output over the tick, and the output at its end.
    """
    taus: Any = tau if isinstance(tau, Command) else jax.tree.map(lambda _: tau, u)
    decay = jax.tree.map(lambda each: jnp.exp(-dt / each), taus)
    # Share of the old command in the mean over the tick.
    left = jax.tree.map(lambda each, decay: each / dt * (1.0 - decay), taus, decay)
    mean, end = (
        jax.tree.map(lambda old, new, share: new + share * (old - new), acting, u, shares) for shares in (left, decay)
    )
    return mean, end


def is_unsaturated(u: Command, limits: tuple[Command, Command]) -> Bool[Array, ""]:
    """Return whether all parts of a command are away from their limits.

    At the limits, vehicles do not follow commands. At the smallest thrust, for example, a mixer adds thrust to reach
    the commanded rates.

    Args:
        u: Command.
        limits: Smallest and largest command.
    """
    low, high, command = (jnp.concatenate([each.c[None], each.omega]) for each in (*limits, u))
    inside = jnp.abs(command - 0.5 * (low + high)) < (0.5 - LIMIT_SHARE) * (high - low)
    return jnp.all(inside)


class RateBiasedModel(AbstractWrapper[X]):
    """A model whose body rates differ from the commanded ones by a constant bias."""

    base: AbstractDynamics[X]
    bias: Float[Array, "3"]
    """Actual minus commanded body rates, body frame [rad/s]."""

    def step(self, s: X, u: Command, a_ext: Float[Array, "3"]) -> X:
        """Advance the base model by one tick under the actual body rates."""
        return self.base.step(s, Command(u.c, u.omega + self.bias), a_ext)


class LaggedModel(AbstractDynamics[LagState[X]]):
    """A model whose commands first pass through the response of the actuators and the rate loop."""

    base: AbstractDynamics[X]
    response: ActuatorResponse

    @property
    def dt(self) -> float:
        """Control tick of the base model [s]."""
        return self.base.dt

    @property
    def settling_ticks(self) -> Float[Array, ""]:
        """Settling time of the response, in addition to that of the base model [ticks]."""
        # A number of ticks that is whole up to rounding errors counts as whole.
        return jnp.ceil(self.response.settling_time / self.dt - 0.01) + self.base.settling_ticks

    def init(self, x: State) -> LagState[X]:
        """Return the state of the base model, with the actuators at hover."""
        return LagState(self.base.init(x), ActuatorState.at(Command.hover(x.p.dtype)))

    def state(self, s: LagState[X]) -> State:
        """Return the vehicle's state."""
        return self.base.state(s.inner)

    def with_state(self, s: LagState[X], x: State) -> LagState[X]:
        """Return ``s`` with (p, R, v) replaced; the hidden state is kept."""
        return LagState(self.base.with_state(s.inner, x), s.actuators)

    def actuators(self, s: LagState[X]) -> ActuatorState:
        """Return the present thrust and body rates."""
        return s.actuators

    def step(self, s: LagState[X], u: Command, a_ext: Float[Array, "3"]) -> LagState[X]:
        """Advance one tick under the mean thrust and body rates over the tick."""
        away, actuators = self.response(s.actuators, u, self.dt)
        mean = jax.tree.map(lambda target, each: target + each / self.dt, self.response.target(u), away)
        return LagState(self.base.step(s.inner, mean, a_ext), actuators)


def with_response(model: AbstractDynamics[Any], response: ActuatorResponse) -> AbstractDynamics[Any]:
    """Return a model with a different actuator response; actuators are added if the model does not have them.

    Args:
        model: A model, which may be wrapped.
        response: Response of thrust and body rates.
    """
    if isinstance(model, LaggedModel):
        return LaggedModel(model.base, response)
    if isinstance(model, AbstractWrapper):
        return dataclasses.replace(model, base=with_response(model.base, response))
    return LaggedModel(model, response)
