"""The bus between the processes of a live flight: the last message of each topic."""

import abc
from typing import NamedTuple


class Message(NamedTuple):
    """What was published last."""

    version: int
    """It rises with every message of its topic, from 1."""
    data: bytes


class Bus(abc.ABC):
    """Topics with one writer each and any number of readers, none of which ever waits for another."""

    @property
    def refused(self) -> int:
        """Messages from outside that were not taken."""
        return 0

    @property
    def fault(self) -> str:
        """Why another end is not heard; empty if nothing is known against it."""
        return ""

    @abc.abstractmethod
    def publish(self, topic: str, data: bytes) -> None:
        """Replace the last message of ``topic``.

        Raises:
            MessageError: There is no such topic, or the message is too long for it.
        """

    @abc.abstractmethod
    def latest(self, topic: str, after: int = 0) -> Message | None:
        """Return the last message of ``topic``, whole and as it was published.

        Args:
            topic: Name.
            after: Version that the caller already has.

        Returns:
            None if there is no newer one.

        Raises:
            MessageError: There is no such topic.
        """

    @abc.abstractmethod
    def close(self) -> None:
        """Let go of the bus; others go on."""
