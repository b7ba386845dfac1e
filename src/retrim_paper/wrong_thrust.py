"""INDI with a wrong thrust effectiveness, as flight methods: the opponent whose vehicle file is wrong by two."""

from functools import partial
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from retrim.config.methods import MethodEntry, MethodRequest, find_method
from retrim.control.wrapped_controller import WrappedController
from retrim.physics.state import Command, State
from retrim.runtime.pilot import ControllerPilot, Pilot


class WrongThrust(WrappedController[Any]):
    """A controller that assumes ``factor`` times the thrust per command."""

    factor: Float[Array, ""]
    """Ratio of the assumed thrust to the thrust that a command causes."""

    def _inner_memory(self, memory: Any) -> Any:
        return memory

    def init(self, x: State) -> Any:
        """Return the memory of the inner controller."""
        return self.inner.init(x)

    def __call__(self, memory: Any, t: Float[Array, ""], x: State) -> tuple[Command, Any]:
        """Return the command that would cause the desired thrust if the assumption were true."""
        u, memory = self.inner(memory, t, x)
        return Command(u.c / self.factor.astype(u.c.dtype), u.omega), memory

    def accept(self, memory: Any, u: Command) -> Any:
        """Remember the thrust that the accepted command causes according to the assumption."""
        return self.inner.accept(memory, Command(u.c * self.factor.astype(u.c.dtype), u.omega))


def _pilot(factor: float, request: MethodRequest) -> Pilot:
    inner = find_method("indi").make(request)
    assert isinstance(inner, ControllerPilot)
    return ControllerPilot(WrongThrust(inner.controller, jnp.array(factor)))


half = MethodEntry(partial(_pilot, 0.5), "INDI, half of the effectiveness assumed")
double = MethodEntry(partial(_pilot, 2.0), "INDI, twice the effectiveness assumed")
