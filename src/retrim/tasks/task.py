"""A task: its starts, reward, termination and error."""

import abc
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key

from ..errors import FrameError
from ..physics.felt_frame import FeltFrame
from ..physics.path_family import Member
from ..physics.state import STANDARD_GRAVITY, Command, State
from .abstract_reference import Point
from .observation import AbstractObservation


class Start(eqx.Module):
    """State and time at the start of a roll-out."""

    t: Float[Array, ""]
    """Time of the task [s], since a roll-out may join a reference at any time."""
    x: State
    member: Member | None = None
    """Vehicle of the roll-out, and the belief of its policy about it; None for the vehicle of the model."""


class AbstractTask(eqx.Module):
    """One drone, one task. Times are seconds since the start; positions are world coordinates [m]."""

    if TYPE_CHECKING:  # to a type checker an abstract variable would be a dataclass field

        @property
        def dt(self) -> float:
            """Control tick [s]; static."""

        @property
        def horizon(self) -> int:
            """Number of ticks of one training roll-out; static."""

        @property
        def observation(self) -> AbstractObservation[Any]:
            """Observation h(x) of training."""
    else:
        dt: eqx.AbstractVar[float]
        horizon: eqx.AbstractVar[int]
        observation: eqx.AbstractVar[AbstractObservation]

    @property
    def observation_in_flight(self) -> AbstractObservation[Any]:
        """Observation used in flight; by default that of training."""
        return self.observation

    @property
    def metric(self) -> str:
        """Name of the error in results."""
        return "steady_error_m"

    @property
    def flight_seconds(self) -> float:
        """Default length of a flight [s]."""
        return 30.0

    @property
    def steady_seconds(self) -> float:
        """Length of the final part of a flight over which its error is averaged as its score [s]."""
        return 2.0

    @abc.abstractmethod
    def home(self) -> Float[Array, "3"]:
        """Return the position around which flights start, world [m]."""

    def target(self, t: Float[Array, ""]) -> Float[Array, "3"]:
        """Return the target position of the vehicle at time ``t`` [s], world [m]."""
        return self.home()

    def wanted(self, t: Float[Array, ""]) -> Point:
        """Return the reference at time ``t`` [s], for controllers that follow one; by default rest at the target."""
        p = self.target(t)
        rest, none = jnp.zeros_like(p), jnp.zeros_like(p[0])
        hover = jnp.zeros(4, dtype=p.dtype).at[0].set(STANDARD_GRAVITY)
        return Point(p, rest, hover, none, rest, rest, none)

    @abc.abstractmethod
    def reset(self, key: Key[Array, ""]) -> Start:
        """Return a random start; the key is consumed."""

    @abc.abstractmethod
    def reward(self, t: Float[Array, ""], x: State, u: Command) -> Float[Array, ""]:
        """Return the reward r(x_t, u_t), differentiable in x and u.

        Args:
            t: Time of the task [s].
            x: State at ``t``.
            u: Command that acts from ``t`` on.
        """

    @abc.abstractmethod
    def terminated(self, t: Float[Array, ""], x: State) -> Bool[Array, ""]:
        """Return whether the vehicle has left the task's bounds; true also for a state that is not finite."""

    @abc.abstractmethod
    def error(self, t: Float[Array, ""], x: State) -> Float[Array, ""]:
        """Return the distance from the target position [m]."""

    def in_frame(self, frame: FeltFrame) -> "AbstractTask":
        """Return the same task for states and commands of ``frame``.

        Raises:
            FrameError: The task does not support other frames.
        """
        raise FrameError(f"{type(self).__name__} cannot be turned into another frame")

    def cross_track(self, x: State) -> Float[Array, ""] | None:
        """Return the distance from the nearest point of the reference [m]; None for a task without a reference."""
        return None


def within(box: Float[Array, ""], x: State, centre: Float[Array, "3"]) -> Bool[Array, ""]:
    """Return whether ``x`` is finite, and at most ``box`` [m] from ``centre`` (world) along every axis."""
    finite = jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(x)])
    inside: Bool[Array, ""] = jnp.all(jnp.abs(x.p - centre) <= box) & jnp.all(finite)
    return inside


def huber(y: Float[Array, " n"]) -> Float[Array, ""]:
    """Return the Huber loss with threshold 1 of the 2-norm of ``y``: |y|^2 / 2 up to 1, |y| - 1/2 beyond.

    The paper uses "the Huber loss" of a vector and leaves open whether it applies to the norm or to each component; the
    norm does not depend on the choice of axes. Value and gradient are exact at zero.
    """
    squared = jnp.sum(y * y)
    inside = squared <= 1.0
    norm = jnp.sqrt(jnp.where(inside, jnp.ones_like(squared), squared))
    return jnp.where(inside, 0.5 * squared, norm - 0.5)
