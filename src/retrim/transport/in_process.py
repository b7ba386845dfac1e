"""Provide a bus within one process, for tests and for threads."""

import threading
from collections.abc import Mapping

from ..errors import MessageError
from .bus import Bus, Message


class MemoryBus(Bus):
    """A bus that keeps the last message of each topic in a dictionary with a lock."""

    def __init__(self, capacities: Mapping[str, int]) -> None:
        """Build a bus; ``capacities`` holds the maximum message length of each topic [bytes]."""
        self._capacities, self._lock = dict(capacities), threading.Lock()
        self._last = dict.fromkeys(capacities, Message(0, b""))

    def latest(self, topic: str, after: int = 0) -> Message | None:
        """Return the last message of ``topic`` if it is newer than ``after``."""
        check_topic(topic, self._capacities)
        with self._lock:
            result = self._last[topic]
        return result if result.version > after else None


class InProcessBus(MemoryBus):
    """A bus of threads that share memory."""

    def publish(self, topic: str, data: bytes) -> None:
        """Replace the last message of ``topic``."""
        check_fits(topic, data, self._capacities)
        with self._lock:
            self._last[topic] = Message(self._last[topic].version + 1, bytes(data))

    def close(self) -> None:
        """Do nothing."""


def check_topic(topic: str, capacities: Mapping[str, int]) -> None:
    """Raise :class:`MessageError` if there is no such topic."""
    if topic not in capacities:
        raise MessageError(f"no topic {topic!r} on this bus; there are {', '.join(sorted(capacities))}")


def check_fits(topic: str, data: bytes, capacities: Mapping[str, int]) -> None:
    """Raise :class:`MessageError` if there is no such topic, or the message is too long for it."""
    check_topic(topic, capacities)
    if len(data) > capacities[topic]:
        raise MessageError(
            f"topic {topic!r}: a message of {len(data)} bytes exceeds the capacity of {capacities[topic]}"
        )
