"""Stabilising hover at a goal (paper, Sec. IV-A.1)."""

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax import random
from jaxtyping import Array, Bool, Float, Key

from ..errors import FrameError
from ..physics import so3
from ..physics.effective_gravity import EffectiveGravityFrame
from ..physics.state import Command, State
from .observation import AbstractObservation
from .task import TILT, AbstractTask, Start, huber, within

RewardRule = Callable[[Float[Array, "3"], State, Command], Float[Array, ""]]
"""Function that returns the reward for a goal [m], a state and a command; differentiable by JAX."""


class AbstractHover(AbstractTask):
    """Fly to ``goal`` and stay there; subclasses differ in their rewards.

    The task terminates when the vehicle is farther than ``box`` [m] from the goal along any axis. The box is wide,
    since in a narrow box a strong disturbance would end every flight before the learner has data.
    """

    goal: Float[Array, "3"]
    """Hover position in the world frame [m]."""
    observation: AbstractObservation[Any]
    box: Float[Array, ""]
    """Half the side of the box [m]."""
    heading: Float[Array, ""]
    """Largest angle between a start's heading and the x axis [rad]; pi for any heading."""
    dt: float = eqx.field(static=True, default=0.02)
    horizon: int = eqx.field(static=True, default=150)
    in_flight: AbstractObservation[Any] | None = None
    """Observation used in flight; None for the training observation."""

    @property
    def observation_in_flight(self) -> AbstractObservation[Any]:
        """Observation used in flight."""
        return self.observation if self.in_flight is None else self.in_flight

    @property
    def rests(self) -> bool:
        """Whether the vehicle comes to rest at the goal."""
        return type(self).target is AbstractHover.target

    @property
    def approaches_target(self) -> bool:
        """Whether a policy may observe a limited distance from the goal; true."""
        return True

    def home(self) -> Float[Array, "3"]:
        """Return the goal in the world frame [m]."""
        return self.goal

    def target(self, t: Float[Array, ""]) -> Float[Array, "3"]:
        """Return the goal in the world frame [m].

        A subclass may move the goal; reward, bounds and error then use the moved goal.
        """
        return self.goal

    def reset(self, key: Key[Array, ""]) -> Start:
        """Draw a start near the goal.

        Each coordinate is within ±1 m of the goal, the yaw within ±``heading``, and the pitch and roll within
        ±18 degrees. The standard deviation of the velocity is 0.1 m/s per axis.
        """
        kp, ka, kv = random.split(key, 3)
        p = self.goal + random.uniform(kp, (3,), minval=-1.0, maxval=1.0)
        roll, pitch, turn = random.uniform(ka, (3,), minval=-1.0, maxval=1.0)
        R = so3.rotx(TILT * roll) @ so3.roty(TILT * pitch) @ so3.rotz(self.heading * turn)
        return Start(jnp.zeros_like(p[0]), State(p, R, 0.1 * random.normal(kv, (3,))))

    def terminated(self, t: Float[Array, ""], x: State) -> Bool[Array, ""]:
        """Return whether the vehicle is outside the box or its state is not finite."""
        return ~within(self.box, x, self.target(t))

    def error(self, t: Float[Array, ""], x: State) -> Float[Array, ""]:
        """Return the distance from the goal [m]."""
        return jnp.sqrt(jnp.sum((x.p - self.target(t)) ** 2))

    def in_frame(self, frame: EffectiveGravityFrame) -> "AbstractHover":
        """Return the task with the same goal in ``frame``.

        Raises:
            FrameError: A subclass overrides ``target``, or the observation does not support other frames.
        """
        if not self.rests:
            raise FrameError(f"{type(self).__name__} overrides target; TaskRequest.hover(goal=...) makes a moving goal")
        return dataclasses.replace(
            self,
            goal=frame.vector(self.goal),
            observation=self.observation.in_frame(frame),
            in_flight=None if self.in_flight is None else self.in_flight.in_frame(frame),
        )


class Hover(AbstractHover):
    """Hover with the paper's reward."""

    def reward(self, t: Float[Array, ""], x: State, u: Command) -> Float[Array, ""]:
        """Return r_pos + r_vel + r_act of the paper; the rate term penalises the commanded body rates."""
        return _paper_reward(self.target(t), x, u)


class CustomHover(AbstractHover):
    """Hover with a user-defined reward."""

    rule: RewardRule = eqx.field(static=True, kw_only=True)
    """Function that returns the reward for a goal [m], a state and a command, in the policy's frame."""

    def reward(self, t: Float[Array, ""], x: State, u: Command) -> Float[Array, ""]:
        """Return the reward from ``rule``."""
        return self.rule(self.target(t), x, u)


class L2Hover(AbstractHover):
    """Hover with a reward that has a tip at the goal; the paper's is flat there and leaves centimetres of error."""

    def reward(self, t: Float[Array, ""], x: State, u: Command) -> Float[Array, ""]:
        """Return the paper's reward minus 3 (sqrt(|p - goal|^2 + (1 cm)^2) - 1 cm)."""
        tip = jnp.sqrt(jnp.sum((x.p - self.target(t)) ** 2) + 0.01**2) - 0.01
        return _paper_reward(self.target(t), x, u) - 3.0 * tip


class StiffHover(AbstractHover):
    """Hover with a reward for stiffness: the command cost is a tenth of the paper's, and the velocity cost a fifth.

    A stiff policy moves less when pushed. Such a policy needs a model with the vehicle's delay and lag.
    """

    def reward(self, t: Float[Array, ""], x: State, u: Command) -> Float[Array, ""]:
        """Return the reward; its tip of 20 (sqrt(|p - goal|^2 + (1 cm)^2) - 1 cm) dominates near the goal."""
        away = x.p - self.target(t)
        tip = jnp.sqrt(jnp.sum(away**2) + 0.01**2) - 0.01
        r_pos = -1.0 * huber(5.0 * away) - 20.0 * tip
        r_vel = -0.02 * huber(x.v) - 0.1 * huber(u.omega)
        return r_pos + r_vel - 0.05 * huber(u.vector() - Command.hover().vector())


def _paper_reward(goal: Float[Array, "3"], x: State, u: Command) -> Float[Array, ""]:
    """Return the paper's reward."""
    r_pos = -1.0 * huber(5.0 * (x.p - goal))
    r_vel = -0.1 * huber(x.v) - 0.1 * huber(u.omega)
    r_act = -0.5 * huber(u.vector() - Command.hover().vector())
    return r_pos + r_vel + r_act
