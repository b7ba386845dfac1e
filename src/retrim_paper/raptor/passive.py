"""Provides the outer controller for a vehicle with its own controller on board."""

from jaxtyping import Array, Float

from retrim.control.controller import AbstractController
from retrim.physics.effective_gravity import EffectiveGravityFrame
from retrim.physics.state import Command, State


class HoverController(AbstractController[tuple[()]]):
    """A controller that commands hover in every state, since the vehicle has its own controller on board."""

    def init(self, x: State) -> tuple[()]:
        """Return an empty memory."""
        return ()

    def __call__(self, memory: tuple[()], t: Float[Array, ""], x: State) -> tuple[Command, tuple[()]]:
        """Return the hover command and the empty memory."""
        return Command.hover(x.p.dtype), memory

    def in_frame(self, frame: EffectiveGravityFrame) -> "HoverController":
        """Return this controller, since hover is the same in every frame."""
        return self
