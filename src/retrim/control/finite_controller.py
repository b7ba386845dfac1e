"""A controller that tolerates non-finite measurements."""

from typing import Any, Generic, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..physics.actuator_response import ActuatorState
from ..physics.effective_gravity import EffectiveGravityFrame
from ..physics.path_family import Member
from ..physics.state import Command, State
from .controller import AbstractController
from .vehicle_report import VehicleReport

LARGEST = float(2**20)
"""Limit of valid measurements, in SI units; networks overflow only far beyond this limit."""

M = TypeVar("M")


class FiniteMemory(eqx.Module, Generic[M]):
    """Memory of a :class:`FiniteController`."""

    inner: M
    """Memory of the inner controller, after the last tick with a finite measurement."""
    last: Command
    """Command of that tick."""
    is_finite: Bool[Array, ""]
    """Whether the newest command follows from the newest measurement."""


class FiniteController(AbstractController[FiniteMemory[Any]]):
    """Repeats the last command and leaves its memory unchanged while the measurement or the command is not finite.

    Exported policies behave in the same way, tick by tick.
    """

    base: AbstractController[Any]

    def init(self, x: State) -> FiniteMemory[Any]:
        """Return the memory of a vehicle that has hovered until now."""
        return FiniteMemory(self.base.init(x), Command.hover(x.p.dtype), jnp.array(True))

    def __call__(
        self, memory: FiniteMemory[Any], t: Float[Array, ""], x: State
    ) -> tuple[Command, FiniteMemory[Any]]:  # fmt: skip
        """Evaluate the inner controller, or repeat the last command."""
        u, inner = self.base(memory.inner, t, x)
        is_finite = _all_below(x) & _all_below(u)
        last, inner = jax.tree.map(
            lambda new, old: jnp.where(is_finite, new, old), (u, inner), (memory.last, memory.inner)
        )
        return last, FiniteMemory(inner, last, is_finite)

    def accept(self, memory: FiniteMemory[Any], u: Command) -> FiniteMemory[Any]:
        """Remember ``u`` as the last command."""
        return FiniteMemory(self.base.accept(memory.inner, u), u, memory.is_finite)

    def with_age(self, age: float | Float[Array, ""]) -> "FiniteController":
        """Return the same controller for measurements that are ``age`` seconds old."""
        return FiniteController(self.base.with_age(age))

    def with_inertial(self, omega: Float[Array, "3"], a: Float[Array, "3"]) -> "FiniteController":
        """Return the same controller for a tick in which body rates and acceleration were measured."""
        return FiniteController(self.base.with_inertial(omega, a))

    def vehicle(self, memory: FiniteMemory[Any]) -> VehicleReport | None:
        """Return the vehicle that the inner controller has identified."""
        return self.base.vehicle(memory.inner)

    def with_vehicle(self, member: Member) -> "FiniteController":
        """Return the same controller for an identified vehicle."""
        return FiniteController(self.base.with_vehicle(member))

    def with_actuators(self, actuators: ActuatorState) -> "FiniteController":
        """Return the same controller for a tick in which thrust and body rates are known."""
        return FiniteController(self.base.with_actuators(actuators))

    def in_frame(self, frame: EffectiveGravityFrame) -> "FiniteController":
        """Return the same controller for states and commands in ``frame``."""
        return FiniteController(self.base.in_frame(frame))


def _all_below(tree: State | Command) -> Bool[Array, ""]:
    """Return whether all numbers are below the limit; return false for NaN."""
    return jnp.all(jnp.stack([jnp.all(jnp.abs(leaf) < LARGEST) for leaf in jax.tree.leaves(tree)]))
