"""Fly a policy in the frame of the effective gravity that its own state estimator observes."""

from typing import Any

from jaxtyping import Array, Float

from ..physics.effective_gravity import EffectiveGravityFrame
from ..physics.state import Command, State
from .controller import AbstractController, PolicyController
from .gravity_frame import limit_norm


class PoseFrame(AbstractController[tuple[Any, Command]]):
    """A policy whose observation has a state estimator, in the frame of the effective gravity that it estimates.

    The policy does not need the measured state.
    """

    inner: PolicyController
    limit: Float[Array, ""]
    """Largest norm of the disturbance that turns the frame [m/s^2]."""

    def __check_init__(self) -> None:
        """Raise ``ValueError`` if the observation does not estimate the disturbance."""
        observation = self.inner.observation
        if observation.state_estimator is None:
            raise ValueError(
                f"PoseFrame: the observation must have a state_estimator, got {type(observation).__name__}, which has "
                "none"
            )

    def init(self, x: State) -> tuple[Any, Command]:
        """Return the memory at the start of a flight."""
        return self.inner.init(x)

    def __call__(
        self, memory: tuple[Any, Command], t: Float[Array, ""], x: State
    ) -> tuple[Command, tuple[Any, Command]]:
        """Return the command of the inner controller, in the frame of the effective gravity one tick ago."""
        (pose, last), estimator = memory, self.inner.observation.state_estimator
        assert estimator is not None
        frame = EffectiveGravityFrame.of(limit_norm(estimator(pose).d, self.limit))
        u, (pose, _) = self.inner.in_frame(frame)((pose, frame.command(last)), t, frame.state(x))
        u = frame.world_command(u)
        return u, (pose, u)

    def accept(self, memory: tuple[Any, Command], u: Command) -> tuple[Any, Command]:
        """Remember the accepted command."""
        return memory[0], u
