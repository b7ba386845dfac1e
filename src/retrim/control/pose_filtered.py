"""Give state-based controllers the state that an observation estimates, such as a pose from camera images.

The estimator of an observation, such as the pose filter of :class:`~retrim.tasks.OccludedKeypoints`, serves policies
and these controllers alike, with the same measurements and the same commands. A controller that uses an inertial unit
continues to do so: the estimated attitude transforms the unit's measurements from the body frame to the world frame.
"""

import dataclasses
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..physics import so3
from ..physics.state import STANDARD_GRAVITY, Command, State
from ..tasks.observation import AbstractObservation
from .wrapped_controller import WrappedController


class PoseFilteredState(eqx.Module):
    """Memory of the observation and of the inner controller."""

    observation: Any
    inner: Any
    last: Command


class PoseFilteredController(WrappedController[PoseFilteredState]):
    """A controller that receives position, attitude and velocity from the state estimator of an observation."""

    observation: AbstractObservation[Any]
    """Observation with a state estimator."""
    omega: Float[Array, "3"] | None = None
    """Measured body rates [rad/s]; None if they are not measured."""
    a: Float[Array, "3"] | None = None
    """Mean acceleration over the last tick, in the world frame [m/s^2]; None if it is not measured."""

    def __check_init__(self) -> None:
        """Raise ``ValueError`` if the observation does not estimate the state."""
        if self.observation.state_estimator is None:
            raise ValueError(
                f"PoseFilteredController: the observation must have a state_estimator, got "
                f"{type(self.observation).__name__}, which has none"
            )

    def with_inertial(self, omega: Float[Array, "3"], a: Float[Array, "3"]) -> "PoseFilteredController":
        """Return the same controller for a tick in which body rates and acceleration were measured."""
        return dataclasses.replace(self, omega=omega, a=a)

    def init(self, x: State) -> PoseFilteredState:
        """Return the memory at the start of a flight; the filter starts near the state, not exactly at it."""
        poses = self.observation.init(x)
        return PoseFilteredState(poses, self.inner.init(self._estimate(poses)), Command.hover(x.p.dtype))

    def __call__(self, memory: PoseFilteredState, t: Float[Array, ""], x: State) -> tuple[Command, PoseFilteredState]:
        """Return the command for the estimated pose; the state only defines the poses of camera and inertial unit."""
        _, poses = self.observation(memory.observation, t, x, memory.last)
        here, controller = self._estimate(poses), self.inner
        if self.omega is not None and self.a is not None:
            gravity = jnp.array([0.0, 0.0, -STANDARD_GRAVITY], dtype=x.p.dtype)
            specific_force = so3.act(x.R.T, self.a - gravity)  # as an accelerometer measures it, in the body frame
            controller = controller.with_inertial(self.omega, so3.act(here.R, specific_force) + gravity)
        u, inner = controller(memory.inner, t, here)
        return u, PoseFilteredState(poses, inner, u)

    def accept(self, memory: PoseFilteredState, u: Command) -> PoseFilteredState:
        """Remember the accepted command, here and in the inner controller."""
        return PoseFilteredState(memory.observation, self.inner.accept(memory.inner, u), u)

    def _estimate(self, poses: Any) -> State:
        estimator = self.observation.state_estimator
        assert estimator is not None
        return estimator(poses).x
