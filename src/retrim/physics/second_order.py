"""Simulate a point mass with a second-order rate loop, for vehicles whose command path is given by numbers.

Thrust and body rates follow their commands as in :class:`~retrim.physics.actuator_response.ActuatorResponse`, exactly
in each millisecond. The model does not have rotors, so every combination of lag, damping and gain is a possible
vehicle.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from . import so3
from .actuator_response import ActuatorResponse, ActuatorState
from .effects import ExternalEffects
from .state import STANDARD_GRAVITY, Command, State
from .substep import SUBSTEP, AbstractSubstepDynamics, check_tick

DRAG = 0.3  # [1/s]


class SecondOrderState(eqx.Module):
    """State of the vehicle and of its actuators."""

    x: State
    actuators: ActuatorState


class SecondOrderQuadrotor(AbstractSubstepDynamics[SecondOrderState]):
    """Point mass with a second-order rate loop, a thrust lag and linear drag, at 1 kHz."""

    response: ActuatorResponse
    mass: Float[Array, ""]
    """Mass without loads [kg]."""
    drag: Float[Array, ""]
    """Linear drag [1/s]."""
    limits: tuple[Command, Command]
    """Smallest and largest command."""
    dt: float = eqx.field(static=True)

    def __check_init__(self) -> None:
        """Raise ``ValueError`` if the tick is not a whole number of milliseconds."""
        check_tick(self.dt, "SecondOrderQuadrotor")

    @property
    def command_limits(self) -> tuple[Command, Command]:
        """The vehicle's smallest and largest commands."""
        return self.limits

    def init(self, x: State) -> SecondOrderState:
        """Return the state of a vehicle that hovers at ``x``, without rotation."""
        # Hover is a thrust of 1 g, independent of the gain of the hover command.
        return SecondOrderState(x, ActuatorState.at(Command.hover(x.p.dtype)))

    def state(self, s: SecondOrderState) -> State:
        """Return (p, R, v)."""
        return s.x

    def with_state(self, s: SecondOrderState, x: State) -> SecondOrderState:
        """Return ``s`` with (p, R, v) replaced."""
        return SecondOrderState(x, s.actuators)

    def body_rates(self, s: SecondOrderState) -> Float[Array, "3"]:
        """Return the body rates [rad/s]."""
        return s.actuators.command.omega

    def substep(self, s: SecondOrderState, u: Command, effects: ExternalEffects) -> SecondOrderState:
        """Advance one millisecond under the mean thrust and the mean body rates over that time."""
        h, x = SUBSTEP, s.x
        away, actuators = self.response(s.actuators, u, h)
        target = self.response.target(u)
        turn = h * target.omega + away.omega
        middle = so3.mul(x.R, so3.exp(0.5 * turn))
        thrust = (target.c + away.c / h) * jnp.mean(effects.gain) * self.mass / (self.mass + effects.mass)
        gravity = jnp.array([0.0, 0.0, -STANDARD_GRAVITY], dtype=x.p.dtype)
        a = thrust * middle[:, 2] + gravity + effects.push - self.drag * (x.v - effects.wind)
        end = so3.mul(x.R, so3.exp(turn))
        after = State(x.p + h * x.v + 0.5 * h**2 * a, end, x.v + h * a)
        return SecondOrderState(after, actuators)
