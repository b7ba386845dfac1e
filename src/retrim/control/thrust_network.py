"""A policy network with the structure of a tracking controller: trainable gains, and a perceptron that corrects them.

The network sees :class:`~retrim.tasks.thrust_preview.ThrustPreview`. Its first part turns the thrust axis towards the
thrust that the path and the feedback need, and commands the turn of this thrust ahead of time. Its gains are trained
together with a small perceptron, which adds to thrust and body rates. Feedback is limited, so that a distant vehicle
does not turn over. Without this structure, a perceptron with a sigmoid must reproduce the thrust to a part in a
thousand over the whole range of the vehicle.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax, random
from jaxtyping import Array, Float, Key

from ..physics.state import STANDARD_GRAVITY, Command
from ..physics.vehicle import Vehicle
from ..tasks.thrust_preview import POINTS, POSITION_SCALE, SPEED_SCALE, STEP
from .policy import command_bounds

FEEDBACK = 8.0  # [m/s^2], largest acceleration of the feedback
TURN = 6.0  # [rad/s], largest body rate of the attitude feedback
CORRECTION = (2.0, 2.0, 2.0, 0.2)  # [m/s^2] and [rad/s], scale of the perceptron's outputs
EDGE = 2e-3  # smallest distance of a command from its limits, as a share of the range


class ThrustNetwork(eqx.Module):
    """Maps an observation to four numbers, which a policy maps to thrust and body rates."""

    gains: Float[Array, "4"]
    """Logarithms of the gains of position [1/s^2], velocity [1/s], attitude and heading [1/s]."""
    lead: Float[Array, " points"]
    """Share of each previewed turn rate in the commanded rates, and of the next thrust in the present one."""
    perceptron: eqx.nn.MLP
    bounds: tuple[Command, Command, Command]
    """Hover command, and the smallest and largest command; these are not trained."""

    @classmethod
    def of(cls, size: int, vehicle: Vehicle, key: Key[Array, ""], hidden: tuple[int, ...]) -> "ThrustNetwork":
        """Return an untrained network; its perceptron adds almost nothing.

        Args:
            size: Length of the observation.
            vehicle: Vehicle with the command limits.
            key: Random key; consumed.
            hidden: Widths of the hidden layers, all equal.
        """
        k_network, k_last = random.split(key)
        net = eqx.nn.MLP(size, 4, hidden[0], len(hidden), jax.nn.tanh, key=k_network)
        last = net.layers[-1]
        weight = 1e-3 * random.normal(k_last, last.weight.shape)
        net = eqx.tree_at(lambda n: (n.layers[-1].weight, n.layers[-1].bias), net, (weight, jnp.zeros(4)))
        lead = jnp.zeros(POINTS).at[1].set(1.0).at[-1].set(0.25)
        return cls(jnp.log(jnp.array([10.0, 5.5, 9.0, 2.0])), lead, net, command_bounds(vehicle))

    def __call__(self, o: Float[Array, " o"]) -> Float[Array, "4"]:
        """Return the numbers whose bounded values are thrust and body rates."""
        error, speed = POSITION_SCALE * o[:3], SPEED_SCALE * o[3:6]
        thrusts = STANDARD_GRAVITY * o[6 : 6 + 3 * POINTS].reshape(POINTS, 3)
        nose = o[6 + 3 * POINTS : 8 + 3 * POINTS]
        position, velocity, attitude, heading = jnp.exp(self.gains)
        desired = thrusts[0] + _limit(position * error + velocity * speed, FEEDBACK)
        up = jnp.array([0.0, 0.0, 1.0], dtype=o.dtype)
        turns = jax.vmap(_turn)(thrusts[:-1], thrusts[1:]) / STEP
        rates = _limit(attitude * _turn(up, desired), TURN) + self.lead[:-1] @ turns
        c = desired[2] + self.lead[-1] * (thrusts[1] - thrusts[0])[2]
        yaw = heading * jnp.arctan2(nose[1], nose[0] + 1e-6)
        u = jnp.stack([c, rates[0], rates[1], yaw]) + jnp.array(CORRECTION, o.dtype) * self.perceptron(o)
        hover, low, high = (lax.stop_gradient(each.vector().astype(o.dtype)) for each in self.bounds)
        share = jnp.clip((u - low) / (high - low), EDGE, 1.0 - EDGE)
        return jnp.log(share / (1.0 - share)) - jnp.log((hover - low) / (high - hover))


def _limit(y: Float[Array, "3"], limit: float) -> Float[Array, "3"]:
    """Return ``y`` with a norm that approaches ``limit`` smoothly."""
    return y / jnp.sqrt(1.0 + jnp.sum(y * y) / limit**2)


def _turn(before: Float[Array, "3"], after: Float[Array, "3"]) -> Float[Array, "3"]:
    """Return the smallest rotation vector from one direction to another [rad]."""
    axis = jnp.cross(before, after)
    sine = jnp.sqrt(jnp.sum(axis * axis) + 1e-12)
    return axis / sine * jnp.arctan2(sine, jnp.sum(before * after))
