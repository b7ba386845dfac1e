"""Implements DATT (Huang et al. 2023), a policy that looks ahead along its reference and receives the disturbance.

The implementation follows the description in the paper, with three changes that improve the results here. Positions are
relative to the reference. Vectors are in the body frame. The observation contains the state in which the command begins
to act, and the command that acts until then.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import random
from jaxtyping import Array, Float, Key

from retrim.control.controller import AbstractController
from retrim.estimation.l1 import L1Estimator, L1State
from retrim.estimation.prediction import Prediction, Underway
from retrim.physics.state import STANDARD_GRAVITY, Command, State
from retrim.tasks.task import AbstractTask

POINTS, SPACING = 10, 0.06  # number of reference points in the observation, and the time between them [s]
STATE_SIZE = 22  # size of the state part: error, velocity, attitude, disturbance, acting command
SIZE = STATE_SIZE + 3 * POINTS
SCALE = (5.0, 3.0, 3.0, 1.0)  # scales of the actions: [m/s^2], [rad/s]


class DattNet(eqx.Module):
    """Actor and critic: two shared convolutions along the look-ahead, then separate networks of three layers."""

    first: Float[Array, "3 3 8"]
    """Kernel: three points, three coordinates, eight channels."""
    first_bias: Float[Array, "8"]
    second: Float[Array, "3 8 8"]
    second_bias: Float[Array, "8"]
    actor: eqx.nn.MLP
    critic: eqx.nn.MLP
    log_std: Float[Array, "4"]

    @classmethod
    def of(cls, *, key: Key[Array, ""], width: int = 64) -> "DattNet":
        """Return a fresh network; its mean action is nearly zero, which is hover."""
        k_first, k_second, k_actor, k_critic = random.split(key, 4)
        size = STATE_SIZE + 8 * (POINTS - 4)
        actor = eqx.nn.MLP(size, 4, width, 3, key=k_actor)
        actor = eqx.tree_at(lambda m: m.layers[-1].weight, actor, 0.01 * actor.layers[-1].weight)
        actor = eqx.tree_at(lambda m: m.layers[-1].bias, actor, jnp.zeros(4))
        return cls(
            random.normal(k_first, (3, 3, 8)) / 3.0,
            jnp.zeros(8),
            random.normal(k_second, (3, 8, 8)) / 24.0**0.5,
            jnp.zeros(8),
            actor,
            eqx.nn.MLP(size, "scalar", width, 3, key=k_critic),
            jnp.full(4, -0.5, dtype=actor.layers[-1].bias.dtype),  # a weak type would compile the first update twice
        )

    def __call__(self, o: Float[Array, " o"]) -> tuple[Float[Array, "4"], Float[Array, ""]]:
        """Return the mean action and the value for an observation from :func:`datt_observation`."""
        ahead = jax.nn.relu(_along(o[STATE_SIZE:].reshape(POINTS, 3), self.first, self.first_bias))
        features = jnp.concatenate([o[:STATE_SIZE], _along(ahead, self.second, self.second_bias).reshape(-1)])
        return self.actor(features), self.critic(features)


def _along(points: Float[Array, "n i"], kernel: Float[Array, "k i c"], bias: Float[Array, " c"]) -> Float[Array, "m c"]:
    """Return a convolution along the points, computed as one product with a banded matrix."""
    n, i = points.shape
    k, _, c = kernel.shape
    m = n - k + 1
    bands = jnp.zeros((n, i, m, c), dtype=kernel.dtype)
    for at in range(m):
        bands = bands.at[at : at + k, :, at].set(kernel)
    return (points.reshape(-1) @ bands.reshape(n * i, m * c)).reshape(m, c) + bias[None]


def datt_observation(x: State, acting: Command, d: Float[Array, "3"], ahead: Float[Array, "n 3"]) -> Float[Array, " o"]:
    """Return the policy's observation.

    Args:
        x: State.
        acting: Command at the actuators.
        d: Disturbance, world frame [m/s^2].
        ahead: Reference positions now and at the times ahead, world frame [m].
    """
    offsets = (x.p[None] - ahead) @ x.R
    acts = (acting.vector() - Command.hover().vector().astype(x.p.dtype)) / jnp.array(SCALE, dtype=x.p.dtype)
    return jnp.concatenate([offsets[0], x.v @ x.R, x.R.reshape(9), d @ x.R, acts, offsets.reshape(-1)])


def datt_command(action: Float[Array, "4"], low: Command, high: Command) -> Command:
    """Return the command for an action, clipped to the limits; a zero action is hover."""
    hover = jnp.array([STANDARD_GRAVITY, 0.0, 0.0, 0.0], dtype=action.dtype)
    command = hover + jnp.array(SCALE, dtype=action.dtype) * action
    return Command.of(command).within(low, high)


class DattState(eqx.Module):
    """Memory of the controller."""

    underway: Underway
    estimate: L1State
    last: State
    """State measured one tick ago."""


class DattController(AbstractController[DattState]):
    """The trained policy in flight, which receives the disturbance from an L1 estimator."""

    net: DattNet
    task: AbstractTask
    """Task that provides the reference."""
    prediction: Prediction
    estimator: L1Estimator
    known: Float[Array, ""]
    """Largest disturbance per axis in training [m/s^2]; the estimate is clipped to it."""
    low: Command
    high: Command

    def with_age(self, age: float | Float[Array, ""]) -> "DattController":
        """Return the same controller for measurements that are ``age`` old [s]."""
        return dataclasses.replace(self, prediction=self.prediction.with_age(age))

    def init(self, x: State) -> DattState:
        """Return the memory at the start of a flight."""
        return DattState(self.prediction.init(x), L1State.start(x), x)

    def __call__(self, memory: DattState, t: Float[Array, ""], x: State) -> tuple[Command, DattState]:
        """Evaluate the network once, in the state in which the command begins to act."""
        thrust = self.prediction.thrust(memory.underway, memory.last.R, x.R)
        estimate = self.estimator(memory.estimate, t, x, thrust)
        d = jnp.clip(estimate.d_hat, -self.known, self.known)
        soon, acting = self.prediction(memory.underway, x, estimate.d_hat)
        times = t + self.prediction.path.delay.astype(t.dtype) + SPACING * jnp.arange(POINTS, dtype=t.dtype)
        ahead = jax.vmap(self.task.target)(times)
        mean, _ = self.net(datt_observation(soon, acting, d, ahead))
        u = datt_command(mean, self.low, self.high)
        return u, DattState(self.prediction.issue(memory.underway, u), estimate, x)

    def accept(self, memory: DattState, u: Command) -> DattState:
        """Remember the accepted command."""
        return dataclasses.replace(memory, underway=self.prediction.accept(memory.underway, u))
