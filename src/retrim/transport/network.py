"""What buses between machines have in common: the last message of each topic, kept by everybody who listens.

A message carries its version and a number of its writer. A writer that was started again, and does not know how far the
one before it counted, is taken for what it is: versions go on rising for every reader. What comes from the same writer
and is not newer is dropped. Ends that share a key sign their messages (:mod:`retrim.transport.session`) and take no
others.
"""

import abc
import secrets
import struct
import threading
from collections.abc import Mapping

from .bus import Bus, Message
from .in_process import check_fits, check_topic
from .session import HEAD as SEAL
from .session import MARK, MISSING, Session

HEAD = struct.Struct("<QQ")
"""Writer and version, before each message."""
OTHER = 0
"""Writer of what a session has taken; no writer has that number."""
DISTRUST = 5.0  # [s] for an end with the key to be heard, once one without it is
FAREWELL = 0.3  # [s] for a message to leave the machine, after which a bus may be closed


class NetworkBus(Bus):
    """A bus whose members tell each other everything."""

    def __init__(self, capacities: Mapping[str, int], session: Session | None = None) -> None:
        """Build one.

        Args:
            capacities: Longest message of each topic [bytes].
            session: Signs messages, and says which are taken; None: all are.
        """
        self._refused, self._fault, self._talk = 0, "", session
        self._answering: threading.Thread | None = None
        self._over = False
        self._capacities, self._lock = dict(capacities), threading.Lock()
        self._last = dict.fromkeys(capacities, Message(0, b""))
        self._heard = dict.fromkeys(capacities, (0, 0))  # writer and its version
        self._me = secrets.randbits(63) + 1

    @abc.abstractmethod
    def _send(self, topic: str, frame: bytes) -> None:
        """Hand a message to the network. It may wait for it, so nobody who must be on time holds such a bus."""

    @property
    def refused(self) -> int:
        """Messages from outside that were none, or nobody's who has the key."""
        return self._refused + (0 if self._talk is None else self._talk.refused)

    @property
    def fault(self) -> str:
        """Why the other end is not heard; empty if nothing is known against it."""
        return self._fault if self._talk is None else self._talk.fault

    def publish(self, topic: str, data: bytes) -> None:
        """Replace the last message of ``topic``."""
        check_fits(topic, data, self._capacities)
        with self._lock:
            message = Message(self._last[topic].version + 1, bytes(data))
            self._last[topic], self._heard[topic] = message, (self._me, message.version)
        self._transmit(topic, message)

    def latest(self, topic: str, after: int = 0) -> Message | None:
        """Return the last message of ``topic`` if it is newer than ``after``."""
        check_topic(topic, self._capacities)
        with self._lock:
            found = self._last[topic]
        return found if found.version > after else None

    def _received(self, topic: str, frame: bytes) -> None:
        """Take a message from the network, in any thread."""
        head = (HEAD if self._talk is None else SEAL).size
        if self._talk is None and frame.startswith(MARK):
            self._refused, self._fault = self._refused + 1, MISSING
        elif len(frame) > head + self._capacities[topic]:
            self._refused += 1
        elif self._talk is not None:
            if (found := self._talk.open(topic, frame)) is not None:
                count, data = found
                self._take(topic, OTHER, count, data)
        elif len(frame) < head:
            self._refused += 1
        else:
            writer, version = HEAD.unpack_from(frame)
            before, known = self._heard[topic]
            if writer != self._me and (writer != before or version > known):
                self._take(topic, writer, version, frame[HEAD.size :])

    def _take(self, topic: str, writer: int, version: int, data: bytes) -> None:
        if version >= 2**62:
            return
        with self._lock:
            self._heard[topic] = writer, version
            self._last[topic] = Message(max(version, self._last[topic].version + 1), data)

    def _transmit(self, topic: str, message: Message) -> None:
        if self._talk is None:
            self._send(topic, HEAD.pack(self._me, message.version) + message.data)
        else:
            self._send(topic, self._talk.seal(topic, message.version, message.data))

    def _begin(self) -> None:
        """Answer what the other end says of itself, in a thread: what receives must not wait for what is sent."""
        if self._talk is not None:
            self._answering = threading.Thread(target=self._answer, daemon=True)
            self._answering.start()

    def _end(self) -> None:
        """Answer no more."""
        self._over = True
        if self._talk is not None and self._answering is not None:
            self._talk.pending.set()
            self._answering.join(FAREWELL)

    def _answer(self) -> None:
        assert self._talk is not None
        while self._talk.pending.wait() and not self._over:
            self._attend()

    def _attend(self) -> None:
        """Send what the session has to send: a greeting, and to a new end the last messages of this one."""
        if self._talk is None:
            return
        due = self._talk.due()
        if due.greeting is not None:
            self._send(self._talk.greeting, due.greeting)
        if due.again:
            with self._lock:
                mine = [topic for topic, (writer, _) in self._heard.items() if writer == self._me]
            for topic in mine:
                self._transmit(topic, self._last[topic])
