"""What an adaptive pilot needs from a learner, in whichever clock or process it works."""

import abc

from ..adapt.updates import Update
from ..learn.window import Window


class Learner(abc.ABC):
    """Takes windows of flight, gives updates. Messages go both ways; no call refers to the pilot."""

    @abc.abstractmethod
    def submit(self, window: Window, tick: int) -> None:
        """Offer a window; ``tick`` counts from the start of the flight. A learner that is busy notes a skip."""

    @abc.abstractmethod
    def poll(self, tick: int) -> list[Update]:
        """Return the updates that have become visible, each once; never block."""

    @abc.abstractmethod
    def receive(self, update: Update) -> None:
        """Take note of an update that the pilot has published, of this learner or another."""

    @abc.abstractmethod
    def reset(self) -> None:
        """Drop what is under way: a new flight starts."""
