"""Base class of controllers that pass every capability on to an inner controller."""

import dataclasses
from typing import Any, Generic, TypeVar

from jaxtyping import Array, Float

from ..physics.actuator_response import ActuatorState
from ..physics.dynamics import Residual
from ..physics.path_family import Member
from ..physics.state import Command, State
from .condition import Condition
from .controller import AbstractController
from .vehicle_report import VehicleEstimate, VehicleReport

M = TypeVar("M")
W = TypeVar("W", bound="WrappedController[Any]")


class WrappedController(AbstractController[M], Generic[M]):
    """A controller around another one; its memory has the field ``inner``."""

    inner: AbstractController[Any]

    def _around(self: W, inner: AbstractController[Any]) -> W:
        return dataclasses.replace(self, inner=inner)

    def _inner_memory(self, memory: Any) -> Any:
        return memory.inner

    def with_age(self: W, age: float | Float[Array, ""]) -> W:
        """Return the same controller for measurements that are ``age`` seconds old."""
        return self._around(self.inner.with_age(age))

    def with_inertial(self: W, omega: Float[Array, "3"], a: Float[Array, "3"]) -> W:
        """Return the same controller for a tick in which body rates and acceleration were measured."""
        return self._around(self.inner.with_inertial(omega, a))

    def with_vehicle(self: W, member: Member) -> W:
        """Return the same controller for an identified vehicle."""
        return self._around(self.inner.with_vehicle(member))

    def with_actuators(self: W, actuators: ActuatorState) -> W:
        """Return the same controller for a tick in which thrust and body rates are known."""
        return self._around(self.inner.with_actuators(actuators))

    def follow(self: W, estimate: VehicleEstimate) -> W:
        """Return the controller for a vehicle that another process identifies."""
        return self._around(self.inner.follow(estimate))

    @property
    def previews_residual(self) -> bool:
        """Whether the inner controller uses a learned residual ahead of time."""
        return self.inner.previews_residual

    def with_residual(self: W, residual: Residual) -> W:
        """Return the same controller with an expected disturbance."""
        return self._around(self.inner.with_residual(residual))

    @property
    def identifies(self) -> bool:
        """Whether the inner controller identifies its vehicle in flight."""
        return self.inner.identifies

    def condition(self, memory: Any) -> Condition | None:
        """Return the condition of the inner controller."""
        return self.inner.condition(self._inner_memory(memory))

    def vehicle(self, memory: Any) -> VehicleReport | None:
        """Return the vehicle that the inner controller has identified."""
        return self.inner.vehicle(self._inner_memory(memory))

    def disturbance(self, memory: Any, x: State, u: Command) -> Float[Array, "3"]:
        """Return the disturbance that the inner controller expects."""
        return self.inner.disturbance(self._inner_memory(memory), x, u)
