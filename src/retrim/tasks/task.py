"""Interface of a task: starts, reward, termination and error."""

import abc
import math
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import random
from jaxtyping import Array, Bool, Float, Key

from ..physics import so3
from ..physics.dynamics import Residual
from ..physics.effective_gravity import EffectiveGravityFrame
from ..physics.path_family import Member
from ..physics.state import STANDARD_GRAVITY, Command, State
from .abstract_reference import Point
from .observation import AbstractObservation


class Start(eqx.Module):
    """State and time at the start of a roll-out."""

    t: Float[Array, ""]
    """Task time [s]; a roll-out may join a reference at any time."""
    x: State
    member: Member | None = None
    """Vehicle of the roll-out and the policy's belief about it; None for the model's vehicle."""


NEAR = 1.0  # [m]: largest distance between a start and the target along an axis
BOX = 5.0  # [m]: largest distance between the vehicle and the target along an axis
TILT = 0.1 * math.pi  # [rad], 18 degrees
SPEED = 0.1  # [m/s]: standard deviation of a start's velocity, relative to the target


class AbstractTask(eqx.Module):
    """Base class of tasks for one vehicle.

    Times are in seconds since the start; positions are in world coordinates [m].

    A custom task defines ``home``, ``reward``, ``observation``, ``dt`` and ``horizon``. If its target moves, it also
    defines ``target``. The other methods have defaults.

    Example::

        class Climb(retrim.AbstractTask):
            observation: retrim.StateObs
            dt: float = 0.02
            horizon: int = 150

            def home(self):
                return jnp.array([0.0, 0.0, 2.0])

            def reward(self, t, x, u):
                return -jnp.sum((x.p - self.home()) ** 2) - 0.1 * jnp.sum(u.omega**2)
    """

    if TYPE_CHECKING:  # to a type checker an abstract variable would be a dataclass field

        @property
        def dt(self) -> float:
            """Length of a control tick [s]; static."""

        @property
        def horizon(self) -> int:
            """Number of ticks in one training roll-out; static."""

        @property
        def observation(self) -> AbstractObservation[Any]:
            """Observation h(x) used in training."""
    else:
        dt: eqx.AbstractVar[float]
        horizon: eqx.AbstractVar[int]
        observation: eqx.AbstractVar[AbstractObservation]

    @property
    def observation_in_flight(self) -> AbstractObservation[Any]:
        """Observation used in flight; by default the training observation."""
        return self.observation

    @property
    def rests(self) -> bool:
        """Whether the vehicle comes to rest at home, so ``adapt.trim`` applies; by default, true for fixed targets."""
        return type(self).target is AbstractTask.target

    @property
    def approaches_target(self) -> bool:
        """Whether a policy may observe a limited distance from the target; by default, false.

        True for a task that only brings the vehicle to its target. From far away, the limit prevents a tilt at which a
        weak vehicle falls.
        """
        return False

    @property
    def metric(self) -> str:
        """Name of the error metric in results."""
        return "steady_error_m"

    @property
    def flight_seconds(self) -> float:
        """Default duration of a flight [s]."""
        return 30.0

    @property
    def steady_seconds(self) -> float:
        """Duration of the final part of a flight, over which the error is averaged to give the score [s]."""
        return 2.0

    @abc.abstractmethod
    def home(self) -> Float[Array, "3"]:
        """Return the position around which flights start, in the world frame [m]."""

    def target(self, t: Float[Array, ""]) -> Float[Array, "3"]:
        """Return the vehicle's target position at time ``t`` [s], in the world frame [m]."""
        return self.home()

    def setpoint(self, t: Float[Array, ""]) -> Point:
        """Return the reference at time ``t`` [s], for controllers that follow one; by default, rest at the target."""
        p = self.target(t)
        rest, none = jnp.zeros_like(p), jnp.zeros_like(p[0])
        hover = jnp.zeros(4, dtype=p.dtype).at[0].set(STANDARD_GRAVITY)
        return Point(p, rest, hover, none, rest, rest, none)

    def reset(self, key: Key[Array, ""]) -> Start:
        """Draw a start; by default, near the target at a random time in a flight.

        The default position is within ±1 m of the target and the attitude within ±18 degrees of level, both per axis.
        The standard deviation of the velocity relative to the target is 0.1 m/s per axis.

        Args:
            key: Random key; consumed.
        """
        k_time, kp, ka, kv = random.split(key, 4)
        t = self.flight_seconds * random.uniform(k_time)
        p, v = jax.jvp(self.target, (t,), (jnp.ones_like(t),))
        R = so3.exp(random.uniform(ka, (3,), p.dtype, minval=-TILT, maxval=TILT))
        near = random.uniform(kp, (3,), p.dtype, minval=-NEAR, maxval=NEAR)
        return Start(t, State(p + near, R, v + SPEED * random.normal(kv, (3,), p.dtype)))

    @abc.abstractmethod
    def reward(self, t: Float[Array, ""], x: State, u: Command) -> Float[Array, ""]:
        """Return the reward r(x_t, u_t), which must be differentiable in x and u.

        Args:
            t: Task time [s].
            x: State at ``t``.
            u: Command that acts from ``t`` onwards.
        """

    def terminated(self, t: Float[Array, ""], x: State) -> Bool[Array, ""]:
        """Return whether the vehicle has left the bounds; by default, more than 5 m from the target along any axis.

        The result must also be true for a state that is not finite.
        """
        return ~within(jnp.array(BOX), x, self.target(t))

    def error(self, t: Float[Array, ""], x: State) -> Float[Array, ""]:
        """Return the error of a state; by default, the distance from the target position [m]."""
        return jnp.sqrt(jnp.sum((x.p - self.target(t)) ** 2))

    def with_residual(self, residual: Residual) -> "AbstractTask":
        """Return the task with an expected disturbance in its observation; by default, it is not observed.

        Args:
            residual: Acceleration beyond the nominal model, world frame [m/s^2].
        """
        del residual
        return self

    def in_frame(self, frame: EffectiveGravityFrame) -> "AbstractTask":
        """Return the same task for states and commands in ``frame``.

        By default, reward, bounds and error are evaluated with the state in the world frame and the command in
        ``frame``. In ``frame``, hovering requires the hover command.

        Raises:
            FrameError: The observation does not support other frames.
        """
        return FramedTask(self, self.observation.in_frame(frame), frame, self.dt, self.horizon)

    def cross_track(self, x: State) -> Float[Array, ""] | None:
        """Return the distance to the nearest point on the reference [m]; None for a task without a reference."""
        return None


class FramedTask(AbstractTask):
    """A task for states and commands in a given frame."""

    task: AbstractTask
    """The task in the world frame."""
    observation: AbstractObservation[Any]
    """Observation of states in the frame."""
    frame: EffectiveGravityFrame
    dt: float = eqx.field(static=True)
    horizon: int = eqx.field(static=True)

    def home(self) -> Float[Array, "3"]:
        """Return the position around which flights start, in the frame."""
        return self.frame.vector(self.task.home())

    def target(self, t: Float[Array, ""]) -> Float[Array, "3"]:
        """Return the target position at time ``t`` [s], in the frame."""
        return self.frame.vector(self.task.target(t))

    def reward(self, t: Float[Array, ""], x: State, u: Command) -> Float[Array, ""]:
        """Return the reward for the world state and the command in the frame."""
        return self.task.reward(t, self.frame.world_state(x), u)

    def terminated(self, t: Float[Array, ""], x: State) -> Bool[Array, ""]:
        """Return whether the vehicle has left the bounds."""
        return self.task.terminated(t, self.frame.world_state(x))

    def error(self, t: Float[Array, ""], x: State) -> Float[Array, ""]:
        """Return the error of the world state."""
        return self.task.error(t, self.frame.world_state(x))


def within(box: Float[Array, ""], x: State, centre: Float[Array, "3"]) -> Bool[Array, ""]:
    """Return whether ``x`` is finite and at most ``box`` [m] from ``centre`` (world) along every axis."""
    finite = jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(x)])
    inside: Bool[Array, ""] = jnp.all(jnp.abs(x.p - centre) <= box) & jnp.all(finite)
    return inside


def huber(y: Float[Array, " n"]) -> Float[Array, ""]:
    """Return the Huber loss of the 2-norm of ``y``, with threshold 1: |y|^2 / 2 up to 1, and |y| - 1/2 beyond.

    The paper uses "the Huber loss" of a vector and leaves open whether it applies to the norm or to each component.
    The norm is used here because it does not depend on the choice of axes. The value and gradient are exact at zero.
    """
    square = jnp.sum(y * y)
    inside = square <= 1.0
    norm = jnp.sqrt(jnp.where(inside, jnp.ones_like(square), square))
    return jnp.where(inside, 0.5 * square, norm - 0.5)
