"""Hover relative to a moving goal."""

import dataclasses
from collections.abc import Callable
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import random
from jaxtyping import Array, Bool, Float, Key

from ..errors import FrameError
from ..physics.actuator_response import ActuatorState
from ..physics.effective_gravity import EffectiveGravityFrame
from ..physics.path_family import PathBelief
from ..physics.state import Command, State
from .abstract_reference import Point
from .hover import AbstractHover
from .observation import AbstractObservation
from .task import AbstractTask, Start
from .wrapped_observation import AbstractWrappedObservation

M = TypeVar("M")
GoalPath = Callable[[Float[Array, ""]], Float[Array, "3"]]
"""Function from time [s] to the goal's world position [m]; three times differentiable by JAX."""


class GoalObs(AbstractWrappedObservation[M]):
    """Observation relative to a moving goal, from the observation of a hover task at the origin."""

    path: GoalPath = eqx.field(static=True)
    frame: EffectiveGravityFrame | None = None
    """Frame of the states; by default, the world frame."""

    def __call__(self, memory: M, t: Float[Array, ""], x: State, last: Command) -> tuple[Float[Array, " o"], M]:
        """Return the observation of the relative state."""
        return self.inner(memory, t, relative_state(self.path, self.frame, t, x), last)

    def with_belief(self, belief: PathBelief) -> "GoalObs[M]":
        """Return the same observation with a different belief about the vehicle."""
        return dataclasses.replace(self, inner=self.inner.with_belief(belief))

    def with_actuators(self, actuators: ActuatorState) -> "GoalObs[M]":
        """Return the same observation with the current thrust and body rates."""
        return dataclasses.replace(self, inner=self.inner.with_actuators(actuators))

    def in_frame(self, frame: EffectiveGravityFrame) -> "GoalObs[M]":
        """Return the observation for states in ``frame``."""
        return GoalObs(self.inner.in_frame(frame), self.path, _only(self.frame, frame))


class MovingGoal(AbstractTask):
    """A hover task around a moving goal; reward, bounds and error apply to the relative position and velocity.

    The policy does not observe the goal's acceleration. For accurate tracking of a fast trajectory, use a reference
    (:class:`~retrim.tasks.track.AbstractTrack`).
    """

    inner: AbstractHover
    """Hover task whose goal is the origin."""
    path: GoalPath = eqx.field(static=True)
    frame: EffectiveGravityFrame | None = None
    """Frame of the states; by default, the world frame."""

    @property
    def dt(self) -> float:
        """Length of a control tick [s]."""
        return self.inner.dt

    @property
    def horizon(self) -> int:
        """Number of ticks in one training roll-out."""
        return self.inner.horizon

    @property
    def observation(self) -> AbstractObservation[Any]:
        """Observation of the relative state."""
        return GoalObs(self.inner.observation, self.path, self.frame)

    @property
    def observation_in_flight(self) -> AbstractObservation[Any]:
        """Observation of the relative state, used in flight."""
        return GoalObs(self.inner.observation_in_flight, self.path, self.frame)

    @property
    def approaches_target(self) -> bool:
        """Whether a policy may observe a limited distance from the goal, as in the hover task."""
        return self.inner.approaches_target

    def home(self) -> Float[Array, "3"]:
        """Return the goal's initial position [m]."""
        return self.target(jnp.zeros_like(self.inner.goal[0]))

    def target(self, t: Float[Array, ""]) -> Float[Array, "3"]:
        """Return the goal's position at time ``t`` [s]."""
        p = self.path(t)
        return p if self.frame is None else self.frame.vector(p)

    def setpoint(self, t: Float[Array, ""]) -> Point:
        """Return the goal's position, derivatives and command at time ``t`` [s]; the heading is zero."""
        one = jnp.ones_like(t)

        def velocity(t: Float[Array, ""]) -> Float[Array, "3"]:
            v: Array = jax.jvp(self.target, (t,), (one,))[1]
            return v

        def acceleration(t: Float[Array, ""]) -> Float[Array, "3"]:
            a: Array = jax.jvp(velocity, (t,), (one,))[1]
            return a

        a, jerk = jax.jvp(acceleration, (t,), (one,))
        none = jnp.zeros_like(t)
        return Point.of(self.target(t), velocity(t), a, jerk, none, none)

    def reset(self, key: Key[Array, ""]) -> Start:
        """Draw a time, and a start of the hover task relative to the goal at that time."""
        k_time, k_start = random.split(key)
        start = self.inner.reset(k_start)
        t = self.flight_seconds * random.uniform(k_time, (), start.t.dtype)
        p, v = jax.jvp(self.path, (t,), (jnp.ones_like(t),))
        return Start(t, State(start.x.p + p, start.x.R, start.x.v + v))

    def reward(self, t: Float[Array, ""], x: State, u: Command) -> Float[Array, ""]:
        """Return the reward of the hover task for the relative state."""
        return self.inner.reward(t, self._relative(t, x), u)

    def terminated(self, t: Float[Array, ""], x: State) -> Bool[Array, ""]:
        """Return whether the vehicle is outside the box around the goal or its state is not finite."""
        return self.inner.terminated(t, self._relative(t, x))

    def error(self, t: Float[Array, ""], x: State) -> Float[Array, ""]:
        """Return the distance from the goal [m]."""
        return self.inner.error(t, self._relative(t, x))

    def in_frame(self, frame: EffectiveGravityFrame) -> "MovingGoal":
        """Return the same task for states and commands in ``frame``."""
        return MovingGoal(self.inner.in_frame(frame), self.path, _only(self.frame, frame))

    def _relative(self, t: Float[Array, ""], x: State) -> State:
        return relative_state(self.path, self.frame, t, x)


def relative_state(path: GoalPath, frame: EffectiveGravityFrame | None, t: Float[Array, ""], x: State) -> State:
    """Return a state relative to a moving goal.

    Args:
        path: Path of the goal.
        frame: Frame of the state; without one, the world frame.
        t: Time [s].
        x: State.
    """
    p, v = jax.jvp(path, (t,), (jnp.ones_like(t),))
    if frame is not None:
        p, v = frame.vector(p), frame.vector(v)
    return State(x.p - p, x.R, x.v - v)


def _only(before: EffectiveGravityFrame | None, frame: EffectiveGravityFrame) -> EffectiveGravityFrame:
    if before is not None:
        raise FrameError("a moving goal cannot be transformed into a frame twice")
    return frame
