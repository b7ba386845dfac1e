"""Interface between an adaptive pilot and its learners, for any clock or process."""

import abc

from ..adapt.updates import Update
from ..adapt.worker import Worker
from ..learn.window import Window


class Learner(abc.ABC):
    """Receives windows of flight and returns updates. It exchanges messages and never calls the pilot."""

    @property
    def batchable(self) -> tuple[Worker, int] | None:
        """Worker that can learn in a batch of flights, and its latency [ticks]; None for a learner that cannot."""
        return None

    @abc.abstractmethod
    def submit(self, window: Window, tick: int) -> None:
        """Offer a window; ``tick`` counts from the start of the flight. A learner that is busy records a skip."""

    @abc.abstractmethod
    def poll(self, tick: int) -> list[Update]:
        """Return the updates that have become visible, each exactly once; never block."""

    @abc.abstractmethod
    def receive(self, update: Update) -> None:
        """Receive an update that the pilot has published, from this learner or another one."""

    @abc.abstractmethod
    def reset(self) -> None:
        """Drop the computation in progress, since a new flight starts."""
