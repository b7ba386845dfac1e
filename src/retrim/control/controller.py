"""Controllers, which map time and state to a command and keep a memory of fixed shape."""

import abc
import dataclasses
from typing import Any, Generic, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..errors import FrameError
from ..physics.actuator_response import ActuatorState
from ..physics.dynamics import Residual
from ..physics.effective_gravity import EffectiveGravityFrame
from ..physics.path_family import Member
from ..physics.state import Command, State
from ..tasks.observation import AbstractObservation
from ..tasks.paced_reference import Clock
from .condition import Condition
from .policy import AbstractPolicy
from .vehicle_report import VehicleEstimate, VehicleReport

M = TypeVar("M")


class AbstractController(eqx.Module, Generic[M]):
    """Base class of learned policies, model-predictive control and classical control laws."""

    @abc.abstractmethod
    def init(self, x: State) -> M:
        """Return the memory for a flight that starts in the state ``x``; JAX traces this method and ``__call__``."""

    @abc.abstractmethod
    def __call__(self, memory: M, t: Float[Array, ""], x: State) -> tuple[Command, M]:
        """Return the next command.

        Args:
            memory: Result of :meth:`init` or of the previous call.
            t: Time since the start of the flight [s].
            x: Measured state.

        Returns:
            The command, and the new memory with the same shapes.
        """

    def accept(self, memory: M, u: Command) -> M:
        """Return the memory after the plant accepted ``u`` instead of the command that was issued last."""
        del u
        return memory

    def with_age(self, age: float | Float[Array, ""]) -> "AbstractController[M]":
        """Return the same controller for measurements that are ``age`` seconds old; by default, the age is ignored."""
        del age
        return self

    def with_inertial(self, omega: Float[Array, "3"], a: Float[Array, "3"]) -> "AbstractController[M]":
        """Return the same controller for a tick with inertial measurements; by default, these are ignored.

        Args:
            omega: Body rates [rad/s].
            a: Mean acceleration over the last tick, world [m/s^2].
        """
        del omega, a
        return self

    def with_vehicle(self, member: Member) -> "AbstractController[M]":
        """Return the same controller for an identified vehicle; by default, the vehicle is ignored.

        Args:
            member: Most likely command path of the vehicle, and the belief about it.
        """
        del member
        return self

    def with_actuators(self, actuators: ActuatorState) -> "AbstractController[M]":
        """Return the same controller for a tick in which thrust and rates are known; by default, these are ignored.

        Args:
            actuators: Present thrust and body rates.
        """
        del actuators
        return self

    def condition(self, memory: M) -> Condition | None:
        """Return the condition of the controller; None for a controller that never steps back."""
        del memory
        return None

    @property
    def identifies(self) -> bool:
        """Whether the controller identifies its vehicle in flight."""
        return False

    def follow(self, estimate: VehicleEstimate) -> "AbstractController[Any]":
        """Return the controller for a vehicle that another process identifies; by default, the estimate is ignored.

        Args:
            estimate: Present estimate of the vehicle.
        """
        del estimate
        return self

    def vehicle(self, memory: M) -> VehicleReport | None:
        """Return the identified vehicle; None for a controller that does not identify the vehicle."""
        del memory
        return None

    def disturbance(self, memory: M, x: State, u: Command) -> Float[Array, "3"]:
        """Return the acceleration that the controller expects beyond its nominal model; zero by default.

        Args:
            memory: Memory of the controller.
            x: State, present or planned.
            u: Command in this state.

        Returns:
            Acceleration in the world frame [m/s^2].
        """
        del memory, u
        return jnp.zeros_like(x.p)

    def clock(self, memory: M) -> Clock | None:
        """Return the clock of the reference; None for a controller whose reference follows the flight time."""
        del memory
        return None

    @property
    def previews_residual(self) -> bool:
        """Whether the controller uses a learned residual ahead of time, so that its frame does not contain it."""
        return False

    def with_residual(self, residual: Residual) -> "AbstractController[M]":
        """Return the same controller with an expected disturbance; by default, it is ignored.

        Args:
            residual: Acceleration beyond the nominal model, world frame [m/s^2].
        """
        del residual
        return self

    def in_frame(self, frame: EffectiveGravityFrame) -> "AbstractController[M]":
        """Return the same controller for states and commands in ``frame``.

        Raises:
            FrameError: The controller does not support other frames.
        """
        raise FrameError(f"{type(self).__name__} cannot be flown in a different frame")


class PolicyController(AbstractController[tuple[Any, Command]]):
    """A policy with its observation; the memory holds the observation's memory and the last command."""

    observation: AbstractObservation[Any]
    policy: AbstractPolicy

    def init(self, x: State) -> tuple[Any, Command]:
        """Return the memory of a vehicle that has hovered until now."""
        return self.observation.init(x), jax.tree.map(lambda leaf: leaf.astype(x.p.dtype), self.policy.u_hover)

    def __call__(
        self, memory: tuple[Any, Command], t: Float[Array, ""], x: State
    ) -> tuple[Command, tuple[Any, Command]]:
        """Evaluate the observation and the policy once."""
        memory_of_observation, last = memory
        o, memory_of_observation = self.observation(memory_of_observation, t, x, last)
        u = self.policy(o)
        return u, (memory_of_observation, u)

    def accept(self, memory: tuple[Any, Command], u: Command) -> tuple[Any, Command]:
        """Remember ``u`` as the last command."""
        return memory[0], u

    def with_vehicle(self, member: Member) -> "PolicyController":
        """Return the same policy with the observation for an identified vehicle."""
        return dataclasses.replace(self, observation=self.observation.with_belief(member.belief))

    def with_actuators(self, actuators: ActuatorState) -> "PolicyController":
        """Return the same policy with the observation for a vehicle whose thrust and rates are known."""
        return dataclasses.replace(self, observation=self.observation.with_actuators(actuators))

    @property
    def previews_residual(self) -> bool:
        """Whether the observation contains a learned residual ahead of time."""
        return self.observation.previews_residual

    def with_residual(self, residual: Residual) -> "PolicyController":
        """Return the same policy with the observation of an expected disturbance."""
        return dataclasses.replace(self, observation=self.observation.with_residual(residual))

    def in_frame(self, frame: EffectiveGravityFrame) -> "PolicyController":
        """Return the same policy with the observation in ``frame``."""
        return dataclasses.replace(self, observation=self.observation.in_frame(frame))
