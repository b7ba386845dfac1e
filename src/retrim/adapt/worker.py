"""Interface of a worker, which computes one learning layer and is independent of clock and process."""

import abc
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, NamedTuple

from ..control.lora import LoraPolicy
from ..learn.stacking import unstack
from ..learn.window import Window
from .updates import Layer, Update


class BatchUpdate(NamedTuple):
    """Results of a batch of workers."""

    states: Any
    """New states (leading axis vehicles); the old state of a vehicle that rejects its result."""
    message: Callable[[int, Any], Update]
    """Returns the message for a vehicle, by its number and the state that the message contains."""

    def unstack(self, n: int) -> list[Update]:
        """Return the messages for the first ``n`` vehicles, each with the vehicle's own state."""
        return [self.message(i, unstack(self.states, i)) for i in range(n)]


class WorkerBatch(abc.ABC):
    """Workers of several vehicles, whose computations run as one program."""

    @classmethod
    @abc.abstractmethod
    def of(cls, workers: Sequence[Any]) -> "WorkerBatch":
        """Return the batch of workers of one class with one learner."""

    @abc.abstractmethod
    def learn(self, states: Any, windows: Window, incumbents: Any = None) -> BatchUpdate:
        """Learn from the window of each vehicle; all arrays have a leading axis of vehicles.

        Args:
            states: State of each worker, see :attr:`Worker.state`.
            windows: Window of each vehicle.
            incumbents: Policies in flight, if they differ from those of ``states``.
        """

    @abc.abstractmethod
    def unstack(self, workers: Sequence[Any]) -> None:
        """Let the workers continue as if each had learned alone; only their random numbers are not in an update."""


class Worker(abc.ABC):
    """Computation of one learning layer on one window.

    A worker's state advances only when the worker receives its own update after publication. A result that is dropped
    on the way (because of a new flight or a lost message) therefore never becomes the base of the next result.

    A class of workers that can also learn as one batch defines ``batch`` and ``state``. A subclass that changes
    ``learn`` does not inherit ``batch``.
    """

    layer: Layer
    learner: Any
    """Online learner of the reference. Workers that form a batch share one learner."""
    batch: ClassVar[type[WorkerBatch] | None] = None
    """Batch that several workers of this class form; None if each worker learns alone."""

    def __init_subclass__(cls, **options: Any) -> None:
        """Drop an inherited batch, which does not compute the same as a new ``learn``."""
        super().__init_subclass__(**options)
        if "learn" in vars(cls) and "batch" not in vars(cls):
            cls.batch = None

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

    @property
    def state(self) -> Any:
        """State from which the next result starts, a pytree; None for a worker that does not form batches."""
        return None

    def state_in(self, state: Any) -> Any:
        """Return the part of a :class:`~retrim.LearnerState` that has the structure of ``state``."""
        return state

    @property
    def low_rank(self) -> LoraPolicy | None:
        """Low-rank policy that the worker trains, whose base it can share with others; None for other workers."""
        return None
