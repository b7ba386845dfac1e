"""Base class of observations that change the state, or the numbers, of another observation."""

from typing import TypeVar

from ..physics.state import State
from .observation import AbstractObservation

M = TypeVar("M")


class AbstractWrappedObservation(AbstractObservation[M]):
    """Observation with the memory and the measurements of an inner observation."""

    inner: AbstractObservation[M]

    @property
    def size(self) -> int:
        """Length of the inner observation."""
        return self.inner.size

    @property
    def measures_state(self) -> bool:
        """Whether the inner observation has a measured state."""
        return self.inner.measures_state

    @property
    def has_frame_in_memory(self) -> bool:
        """Whether the memory of the inner observation depends on the frame."""
        return self.inner.has_frame_in_memory

    def init(self, x: State) -> M:
        """Return the memory of the inner observation."""
        return self.inner.init(x)
