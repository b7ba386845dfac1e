"""Controllers that need the state, flown from what a camera sees.

The filter that estimates the pose behind :class:`OccludedKeypoints` for a policy estimates it for them too, from the
same points and the same commands, so that both are told the same.
"""

import dataclasses
from typing import Any

import equinox as eqx
from jaxtyping import Array, Float

from ..physics.state import Command, State
from ..tasks.occluded import OccludedKeypoints, OccludedMemory
from .controller import AbstractController


class SeenPoseState(eqx.Module):
    """Memory of the filter and of the controller inside."""

    seen: OccludedMemory
    inner: Any
    last: Command


class SeenPose(AbstractController[SeenPoseState]):
    """Any controller, shown the position, attitude and velocity that the pose filter of the keypoints estimates."""

    observation: OccludedKeypoints
    inner: AbstractController[Any]

    def aged(self, age: float | Float[Array, ""]) -> "SeenPose":
        """Return the same for frames that are ``age`` old [s]."""
        return dataclasses.replace(self, inner=self.inner.aged(age))

    def sensing(self, omega: Float[Array, "3"], a: Float[Array, "3"]) -> "SeenPose":
        """Return the same for a tick in which body rates and acceleration were measured."""
        return dataclasses.replace(self, inner=self.inner.sensing(omega, a))

    def init(self, x: State) -> SeenPoseState:
        """Return the memory at the start of a flight: the filter begins near the state, not in it."""
        seen = self.observation.init(x)
        return SeenPoseState(seen, self.inner.init(seen.pose.x), Command.hover(x.p.dtype))

    def __call__(self, memory: SeenPoseState, t: Float[Array, ""], x: State) -> tuple[Command, SeenPoseState]:
        """Decide for the pose that is estimated; the state is where the camera is, and nothing else sees it."""
        _, seen = self.observation(memory.seen, t, x, memory.last)
        u, inner = self.inner(memory.inner, t, seen.pose.x)
        return u, SeenPoseState(seen, inner, u)

    def accepted(self, memory: SeenPoseState, u: Command) -> SeenPoseState:
        """Remember the accepted command, here and in the controller inside."""
        return SeenPoseState(memory.seen, self.inner.accepted(memory.inner, u), u)
