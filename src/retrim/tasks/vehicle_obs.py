"""Observation of a policy for many vehicles: task observation, actuators, and the belief about the vehicle."""

import dataclasses
from collections.abc import Callable
from typing import Any, TypeVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..physics.actuator_response import ActuatorState
from ..physics.effective_gravity import EffectiveGravityFrame
from ..physics.path_family import COORDINATES, PathBelief
from ..physics.state import STANDARD_GRAVITY, Command, State
from .observation import AbstractObservation
from .state_estimate import StateEstimate
from .wrapped_observation import AbstractWrappedObservation

M = TypeVar("M")


class VehicleObs(AbstractWrappedObservation[M]):
    """o = [task observation, thrust, body rates and their slope, belief]: 15 more numbers than the task observation.

    The task observation should contain as many past commands as the longest delay has ticks, since these may not have
    acted yet. A slow vehicle continues to turn long after the last command, so the thrust and rates are also observed.
    The belief contains the centre and half-width of the interval for each coordinate of the command path; see
    :class:`~retrim.physics.path_family.PathBelief`.
    """

    omega_max: Float[Array, "3"]
    """Scale of body rates [rad/s]."""
    belief: PathBelief
    actuators: ActuatorState
    """Current thrust and body rates."""

    @classmethod
    def of(cls, inner: AbstractObservation[M], omega_max: Float[Array, "3"], belief: PathBelief) -> "VehicleObs[M]":
        """Return the observation of a hovering vehicle.

        Args:
            inner: Task observation.
            omega_max: Scale of body rates [rad/s].
            belief: Belief about the vehicle.
        """
        return cls(inner, omega_max, belief, ActuatorState.at(Command.hover()))

    @property
    def size(self) -> int:
        """Length of the observation: that of the task observation plus 15."""
        return self.inner.size + 7 + 2 * COORDINATES

    @property
    def state_estimator(self) -> Callable[[M], StateEstimate] | None:
        """State estimator of the task observation."""
        return self.inner.state_estimator

    def __call__(self, memory: M, t: Float[Array, ""], x: State, last: Command) -> tuple[Float[Array, " o"], M]:
        """Return the task observation with the scaled actuators and belief."""
        inner_observation, memory = self.inner(memory, t, x, last)
        acting, slope = self.actuators.command, self.actuators.slope
        thrust = (acting.c / STANDARD_GRAVITY - 1.0)[None]
        parts = (thrust, acting.omega / self.omega_max, slope / self.omega_max, self.belief.vector())
        return jnp.concatenate([inner_observation, *(each.astype(inner_observation.dtype) for each in parts)]), memory

    def with_belief(self, belief: PathBelief) -> "VehicleObs[M]":
        """Return the same observation with a different belief."""
        return dataclasses.replace(self, belief=belief)

    def with_actuators(self, actuators: ActuatorState) -> "VehicleObs[M]":
        """Return the same observation with the current thrust and body rates."""
        return dataclasses.replace(self, actuators=actuators)

    def at_rest(self, x: State) -> Float[Array, " o"]:
        """Return the observation of a vehicle at rest in ``x``."""
        hover = Command.hover(x.p.dtype)
        still = self.with_actuators(ActuatorState.at(hover))
        return still(self.init(x), jnp.zeros_like(x.p[0]), x, hover)[0]

    def in_frame(self, frame: EffectiveGravityFrame) -> "VehicleObs[M]":
        """Return the observation in ``frame``; the actuators must also be in that frame."""
        inner_in_frame: AbstractObservation[Any] = self.inner.in_frame(frame)
        return dataclasses.replace(self, inner=inner_in_frame)
