"""What buses between machines have in common: the last message of each topic, kept by everybody who listens.

A message carries its version and a number of its writer. A writer that was started again, and does not know how far the
one before it counted, is taken for what it is: versions go on rising for every reader. What comes from the same writer
and is not newer is dropped.
"""

import abc
import secrets
import struct
import threading
from collections.abc import Mapping

from .bus import Bus, Message
from .in_process import check_fits, check_topic

HEAD = struct.Struct("<QQ")
"""Writer and version, before each message."""
FAREWELL = 0.3  # [s] for a message to leave the machine, after which a bus may be closed


class NetworkBus(Bus):
    """A bus whose members tell each other everything."""

    def __init__(self, capacities: Mapping[str, int]) -> None:
        """Build one; ``capacities`` are the longest messages of its topics, in bytes."""
        self.refused = 0
        """Messages from outside that were none."""
        self._capacities, self._lock = dict(capacities), threading.Lock()
        self._last = dict.fromkeys(capacities, Message(0, b""))
        self._heard = dict.fromkeys(capacities, (0, 0))  # writer and its version
        self._me = secrets.randbits(63) + 1

    @abc.abstractmethod
    def _send(self, topic: str, frame: bytes) -> None:
        """Hand a message to the network. It may wait for it, so nobody who must be on time holds such a bus."""

    def publish(self, topic: str, data: bytes) -> None:
        """Replace the last message of ``topic``."""
        check_fits(topic, data, self._capacities)
        with self._lock:
            message = Message(self._last[topic].version + 1, bytes(data))
            self._last[topic], self._heard[topic] = message, (self._me, message.version)
        self._send(topic, HEAD.pack(self._me, message.version) + message.data)

    def latest(self, topic: str, after: int = 0) -> Message | None:
        """Return the last message of ``topic`` if it is newer than ``after``."""
        check_topic(topic, self._capacities)
        with self._lock:
            found = self._last[topic]
        return found if found.version > after else None

    def _received(self, topic: str, frame: bytes) -> None:
        """Take a message from the network, in any thread."""
        if not HEAD.size <= len(frame) <= HEAD.size + self._capacities[topic]:
            self.refused += 1
            return
        writer, version = HEAD.unpack_from(frame)
        with self._lock:
            before, known = self._heard[topic]
            if writer == self._me or (writer == before and version <= known) or version >= 2**62:
                return
            self._heard[topic] = writer, version
            number = max(version, self._last[topic].version + 1)
            self._last[topic] = Message(number, frame[HEAD.size :])
