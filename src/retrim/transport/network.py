"""Implement the common parts of the buses between machines; every listener keeps the last message of each topic.

A message carries its version and the number of its writer. A restarted writer does not have its predecessor's last
version. Readers recognise the restart by the new number, and versions continue to increase for every reader. A message
from the same writer that is not newer is dropped. Ends that share a key sign their messages
(:mod:`retrim.transport.session`) and reject all others.
"""

import abc
import secrets
import struct
import threading
from collections.abc import Mapping

from .bus import Message
from .in_process import MemoryBus, check_fits
from .session import HEAD as SEAL
from .session import MARK, MISSING_KEY, Session

HEAD = struct.Struct("<QQ")
"""Writer and version, before each message."""
OTHER = 0
"""Writer number of messages that a session has accepted; no real writer has it."""
DISTRUST = 5.0  # time in which an end with the key must be received after a message from an end without it [s]
FAREWELL = 0.3  # time for a message to leave the machine before a bus is closed [s]


class NetworkBus(MemoryBus):
    """A bus whose members exchange all messages."""

    def __init__(self, capacities: Mapping[str, int], session: Session | None = None) -> None:
        """Build a bus.

        Args:
            capacities: Maximum length of a message, by topic [bytes].
            session: Signs messages and decides which are accepted; None to accept all.
        """
        super().__init__(capacities)
        self._refusals, self._fault, self._talk = 0, "", session
        self._answering: threading.Thread | None = None
        self._over = False
        # Held from the choice of a message until it is sent: a repeated message must not overtake a newer one.
        self._sending = threading.Lock()
        self._versions = dict.fromkeys(capacities, (0, 0))  # writer and its version
        self._me = secrets.randbits(63) + 1

    @abc.abstractmethod
    def _send(self, topic: str, frame: bytes) -> None:
        """Send a message to the network. This may block, so a process with deadlines must not use such a bus."""

    @property
    def refusals(self) -> int:
        """Number of messages from outside that were malformed or not signed with the key."""
        return self._refusals + (0 if self._talk is None else self._talk.refusals)

    @property
    def fault(self) -> str:
        """Reason why the other end's messages are not received; empty if no fault is known."""
        return self._fault if self._talk is None else self._talk.fault

    def publish(self, topic: str, data: bytes) -> None:
        """Replace the last message of ``topic``."""
        check_fits(topic, data, self._capacities)
        with self._sending:
            with self._lock:
                message = Message(self._last[topic].version + 1, bytes(data))
                self._last[topic], self._versions[topic] = message, (self._me, message.version)
            self._transmit(topic, message)

    def _receive(self, topic: str, frame: bytes) -> None:
        """Receive a message from the network, in any thread."""
        head = (HEAD if self._talk is None else SEAL).size
        if self._talk is None and frame.startswith(MARK):
            self._refusals, self._fault = self._refusals + 1, MISSING_KEY
        elif len(frame) > head + self._capacities[topic]:
            self._refusals += 1
        elif self._talk is not None:
            if (result := self._talk.open(topic, frame)) is not None:
                count, data = result
                self._take(topic, OTHER, count, data)
        elif len(frame) < head:
            self._refusals += 1
        else:
            writer, version = HEAD.unpack_from(frame)
            before, last_version = self._versions[topic]
            if writer != self._me and (writer != before or version > last_version):
                self._take(topic, writer, version, frame[HEAD.size :])

    def _take(self, topic: str, writer: int, version: int, data: bytes) -> None:
        if version >= 2**62:
            return
        with self._lock:
            self._versions[topic] = writer, version
            self._last[topic] = Message(max(version, self._last[topic].version + 1), data)

    def _transmit(self, topic: str, message: Message) -> None:
        if self._talk is None:
            self._send(topic, HEAD.pack(self._me, message.version) + message.data)
        else:
            self._send(topic, self._talk.seal(topic, message.version, message.data))

    def _begin(self) -> None:
        """Start a thread that answers the other end's greetings, since the receiving thread must not wait to send."""
        if self._talk is not None:
            self._answering = threading.Thread(target=self._answer, daemon=True)
            self._answering.start()

    def _end(self) -> None:
        """Stop answering."""
        self._over = True
        if self._talk is not None and self._answering is not None:
            self._talk.pending.set()
            self._answering.join(FAREWELL)

    def _answer(self) -> None:
        assert self._talk is not None
        while self._talk.pending.wait() and not self._over:
            self._attend()

    def _attend(self) -> None:
        """Send the pending messages of the session: a greeting, and this end's last messages to a new end."""
        if self._talk is None:
            return
        due = self._talk.due()
        if due.greeting is not None:
            self._send(self._talk.greeting, due.greeting)
        if due.again:
            with self._lock:
                mine = [topic for topic, (writer, _) in self._versions.items() if writer == self._me]
            for topic in mine:
                with self._sending:
                    self._transmit(topic, self._last[topic])
