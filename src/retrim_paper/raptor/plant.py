"""Models a vehicle without a rate controller, whose motors are commanded by RAPTOR.

RAPTOR is a foundation policy with 2,084 weights. It was distilled from a thousand teachers, each for a different
vehicle, and adapts through its hidden state (Eschmann, Albani and Loianno 2025). It runs on board at 100 Hz and
observes its vehicle without delay; only the reference comes from outside. Differences from the reference are clipped as
in the flight firmware that contains RAPTOR.
"""

import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax, random
from jaxtyping import Array, Float, Int

from retrim.physics import so3
from retrim.physics.bem import BemQuadrotor, BemState
from retrim.physics.effects import ExternalEffects
from retrim.physics.motors import CommandedSpeeds
from retrim.physics.state import Command, State
from retrim.physics.substep import SUBSTEP, AbstractSubstepDynamics, RotorState
from retrim.plants.extras import import_extra

PERIOD = 10  # [ms], time between two decisions
LARGEST_DISTANCE, LARGEST_SPEED = 0.5, 1.0  # [m], [m/s]: largest differences from the reference in the observation
ORDER = (0, 2, 1, 3)  # RAPTOR's rotor for each of ours; its order is front-right, back-right, back-left, front-left


class RaptorNet(eqx.Module):
    """The network: a linear layer, a gated recurrent unit, and a linear layer."""

    first: eqx.nn.Linear
    unit: eqx.nn.GRUCell
    last: eqx.nn.Linear
    start: Float[Array, " hidden"]
    """Hidden state at the start of a flight."""

    @classmethod
    def load(cls) -> "RaptorNet":
        """Return the network from the package ``foundation-policy``.

        Raises:
            PlantError: The package is not installed.
        """
        first, unit, last = _layers()
        inputs, hidden = unit.weights_input.shape[1], unit.hidden_dim
        # The library's unit has one bias for the sum of both inputs of a gate, and a separate one for the candidate.
        both = unit.biases_input + np.append(unit.biases_hidden[: 2 * hidden], np.zeros(hidden))
        weights = unit.weights_input, unit.weights_hidden, both, unit.biases_hidden[2 * hidden :]
        cell = eqx.tree_at(
            lambda cell: (cell.weight_ih, cell.weight_hh, cell.bias, cell.bias_n),
            eqx.nn.GRUCell(inputs, hidden, key=random.key(0)),
            tuple(jnp.asarray(each, dtype=float) for each in weights),
        )
        return cls(_linear(first), cell, _linear(last), jnp.asarray(unit.initial_hidden_state, dtype=float))

    def __call__(
        self, hidden: Float[Array, " hidden"], o: Float[Array, "22"]
    ) -> tuple[Float[Array, "4"], Float[Array, " hidden"]]:
        """Return four motor commands and the next hidden state.

        Args:
            hidden: Hidden state.
            o: Observation: position difference from the reference [m], attitude by rows (together 12 numbers), velocity
                difference [m/s] (3 numbers), body rates [rad/s], and the last commands.
        """
        hidden = self.unit(jax.nn.relu(self.first(o)), hidden)
        return self.last(hidden), hidden


@functools.cache
def _layers() -> tuple[Any, ...]:
    """Return the package's layers as NumPy arrays; cached, so that the file is read and checked only once."""
    return tuple(
        import_extra("foundation_policy", "raptor", package="foundation-policy", kind="method").Raptor().layers
    )


def _linear(layer: Any) -> eqx.nn.Linear:
    n_out, n_in = layer.weights.shape
    fresh = eqx.nn.Linear(n_in, n_out, key=random.key(0))
    weights = jnp.asarray(layer.weights, dtype=float), jnp.asarray(layer.biases, dtype=float).reshape(-1)
    linear_layer: eqx.nn.Linear = eqx.tree_at(lambda linear: (linear.weight, linear.bias), fresh, weights)
    return linear_layer


class RaptorState(eqx.Module):
    """State of a vehicle flown by RAPTOR."""

    body: BemState
    hidden: Float[Array, " hidden"]
    action: Float[Array, "4"]
    """Last commands, as returned by the network; the motors accept -1 to 1."""
    ms: Int[Array, ""]
    """Time since the start of the flight [ms]."""


class RaptorQuadrotor(AbstractSubstepDynamics[RaptorState]):
    """A blade-element vehicle with RAPTOR on board; it ignores commands from outside."""

    base: BemQuadrotor
    net: RaptorNet
    setpoint: Any
    """Reference: a function of the time since the start of the flight [s], which returns p, v and the heading."""

    @property
    def dt(self) -> float:
        """Control tick of the outer loop [s]."""
        return self.base.dt

    def init(self, x: State) -> RaptorState:
        """Return the state of a hovering vehicle with RAPTOR switched on."""
        zero = jnp.zeros(4, dtype=x.p.dtype)
        return RaptorState(self.base.init(x), self.net.start.astype(x.p.dtype), zero, jnp.array(0))

    def state(self, s: RaptorState) -> State:
        """Return (p, R, v)."""
        return self.base.state(s.body)

    def with_state(self, s: RaptorState, x: State) -> RaptorState:
        """Replace (p, R, v)."""
        return RaptorState(self.base.with_state(s.body, x), s.hidden, s.action, s.ms)

    def rotor_state(self, s: RaptorState) -> RotorState:
        """Return the body rates and the rotor speeds."""
        return self.base.rotor_state(s.body)

    def substep(self, s: RaptorState, u: Command, effects: ExternalEffects) -> RaptorState:
        """Advance by one millisecond; every tenth one begins with a decision."""
        action, hidden = lax.cond(s.ms % PERIOD == 0, lambda: self._decide(s), lambda: (s.action, s.hidden))
        vehicle = self.base.vehicle
        throttle = 0.5 * (jnp.clip(action, -1.0, 1.0) + 1.0)[jnp.array(ORDER)]
        speeds = vehicle.motor_min + throttle * (vehicle.motor_max - vehicle.motor_min)
        model_at_speeds = BemQuadrotor(vehicle, CommandedSpeeds(speeds, self.base.loop.thrust_map), self.base.dt)
        return RaptorState(model_at_speeds.substep(s.body, u, effects), hidden, action, s.ms + 1)

    def _decide(self, s: RaptorState) -> tuple[Float[Array, "4"], Float[Array, " hidden"]]:
        body, x = s.body.body, self.state(s)
        setpoint = self.setpoint(SUBSTEP * s.ms.astype(x.p.dtype))
        facing = so3.rotz(setpoint.heading).T
        p = jnp.clip(so3.act(facing, x.p - setpoint.p), -LARGEST_DISTANCE, LARGEST_DISTANCE)
        v = jnp.clip(so3.act(facing, x.v - setpoint.v), -LARGEST_SPEED, LARGEST_SPEED)
        o = jnp.concatenate([p, so3.mul(facing, x.R).reshape(9), v, body.omega, s.action])
        return self.net(s.hidden, o)
