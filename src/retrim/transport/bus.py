"""Define the bus between the processes of a live flight; the bus holds the last message of each topic."""

import abc
from typing import NamedTuple


class Message(NamedTuple):
    """The last published message of a topic."""

    version: int
    """Version; it starts at 1 and increases with every message of the topic."""
    data: bytes


class Bus(abc.ABC):
    """Topics with one writer each and any number of readers; writers and readers never wait for each other."""

    @property
    def refusals(self) -> int:
        """Number of rejected messages from outside."""
        return 0

    @property
    def fault(self) -> str:
        """Reason why the other end's messages are not received; empty if no fault is known."""
        return ""

    @abc.abstractmethod
    def publish(self, topic: str, data: bytes) -> None:
        """Replace the last message of ``topic``.

        Raises:
            MessageError: There is no such topic, or the message is too long for it.
        """

    @abc.abstractmethod
    def latest(self, topic: str, after: int = 0) -> Message | None:
        """Return the last message of ``topic``, complete and unchanged.

        Args:
            topic: Name of the topic.
            after: Version that the caller already has.

        Returns:
            The message; None if there is no newer one.

        Raises:
            MessageError: There is no such topic.
        """

    @abc.abstractmethod
    def close(self) -> None:
        """Leave the bus; other processes continue to use it."""
