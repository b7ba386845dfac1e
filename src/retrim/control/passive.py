"""The controller of a vehicle that flies itself."""

from jaxtyping import Array, Float

from ..physics.felt_frame import FeltFrame
from ..physics.state import Command, State
from .controller import AbstractController


class Passive(AbstractController[tuple[()]]):
    """Commands hover, whatever it sees: what decides is on board."""

    def init(self, x: State) -> tuple[()]:
        """Return nothing: there is nothing to remember."""
        return ()

    def __call__(self, memory: tuple[()], t: Float[Array, ""], x: State) -> tuple[Command, tuple[()]]:
        """Return u_hover."""
        return Command.hover(x.p.dtype), memory

    def in_frame(self, frame: FeltFrame) -> "Passive":
        """Return itself: hover is hover in every frame."""
        return self
