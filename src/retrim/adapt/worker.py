"""Interface of a worker, which computes one learning layer and is independent of clock and process."""

import abc
from typing import Any

from ..learn.window import Window
from .updates import Layer, Update


class Worker(abc.ABC):
    """Computation of one learning layer on one window.

    A worker's state advances only when the worker receives its own update after publication. A result that is dropped
    on the way (because of a new flight or a lost message) therefore never becomes the base of the next result.
    """

    layer: Layer

    @abc.abstractmethod
    def learn(self, window: Window) -> Update:
        """Learn from a window; block until the result is available."""

    @abc.abstractmethod
    def receive(self, update: Update) -> None:
        """Receive a published update of this or another layer."""

    def follow(self, learner: Any) -> None:
        """Continue with a different reference.

        Args:
            learner: Online learner of the new reference.
        """
        self.learner = learner
