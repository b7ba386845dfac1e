"""Authenticate the messages between two ends that share a key.

Each end draws a random number when it starts. A message contains the number of its sender, the number of its receiver,
and a count. HMAC-SHA256 covers these, the topic, the vehicle and the payload. An end accepts a message only if the
message contains that end's own number and is newer than all previous ones. Messages from an earlier session and
repeated messages are therefore rejected, even by an end that has just been started, and clocks need not be
synchronised. When an end receives a message from another end for the first time, it sends that end a greeting with its
own number. The last message of each topic is then sent once more, to the new end.
"""

import hmac
import secrets
import struct
import threading
from typing import NamedTuple

from .shared_key import SharedKey

MARK = b"signed1\xff"
"""Beginning of every signed message: format and version. Unsigned messages never begin with it."""
HEAD = struct.Struct("<8s16s16sQ32s")
"""Mark, sender, receiver, count, code."""
NO_SENDER = bytes(16)
GREETINGS = "greeting.flight", "greeting.ground"
"""Greeting topics of the end that listens and of the end that connects."""
UNSIGNED = "the other end has no key; start it with --key FILE or RETRIM_KEY, the same as here"
FOREIGN_KEY = "the other end has another key; --key FILE or RETRIM_KEY must be the same at both ends"
MISSING_KEY = "the other end has a key, and this one has none; start it with --key FILE or RETRIM_KEY"


class Due(NamedTuple):
    """Messages that an end has to send."""

    greeting: bytes | None
    """Signed greeting; None if no greeting is due."""
    again: bool
    """Whether to send the last message of each topic once more."""


class Session:
    """One end of the session; several threads may use it."""

    def __init__(self, key: SharedKey, vehicle: str, greeting: str) -> None:
        """Begin a session.

        Args:
            key: Key that is shared with the other end.
            vehicle: Name of the vehicle, if several share an address.
            greeting: Topic on which this end greets the other one.
        """
        self.greeting = greeting
        self.fault = ""
        """Reason why messages are refused until the other end is accepted; empty afterwards."""
        self.refusals = 0
        """Number of refused messages: forged or repeated."""
        self.pending = threading.Event()
        """Set while a message is due."""
        self.pending.set()
        self._key, self._vehicle, self._me = key, vehicle.encode(), secrets.token_bytes(16)
        self._peer, self._former = NO_SENDER, set[bytes]()
        self._greet: bytes | None = NO_SENDER
        self._greeting: bytes | None = None
        self._again, self._greetings = False, 0
        self._newest = dict[str, int]()
        self._lock = threading.RLock()

    def seal(self, topic: str, count: int, data: bytes) -> bytes:
        """Return a signed message for the other end; the counts of a topic must increase."""
        return self._seal(topic, self._peer, count, data)

    def open(self, topic: str, frame: bytes) -> tuple[int, bytes] | None:
        """Return the count and payload of a message if it is new, from the other end, and addressed to this end."""
        if not frame.startswith(MARK) or len(frame) < HEAD.size:
            self._refuse(UNSIGNED)
            return None
        _, sender, receiver, count, code = HEAD.unpack_from(frame)
        data = frame[HEAD.size :]
        if not hmac.compare_digest(code, self._code(topic, sender, receiver, count, data)):
            self._refuse(FOREIGN_KEY)
            return None
        with self._lock:
            if sender == self._me:  # an echo
                return None
            if sender in self._former:
                self._refuse("")
                return None
            if receiver != self._me:  # it may be an old message, so its sender must prove that it is running
                if self._greeting != sender:
                    self._greet = sender
                    self.pending.set()
                return None
            if sender != self._peer:
                self._meet(sender)
            if count <= self._newest.get(topic, 0):
                self._refuse("")
                return None
            self._newest[topic] = count
        return None if topic in GREETINGS else (count, data)

    def due(self) -> Due:
        """Return the due messages and clear them."""
        with self._lock:
            greet, again = self._greet, self._again
            self._greet, self._again = None, False
            self.pending.clear()
            if greet is None:
                return Due(None, again)
            self._greeting, self._greetings = greet, self._greetings + 1
            return Due(self._seal(self.greeting, greet, self._greetings, b""), again)

    def _meet(self, sender: bytes) -> None:
        """Accept an end that has sent this end's number: it is running, and replaces the previous one."""
        if self._peer != NO_SENDER:
            self._former.add(self._peer)
        self._peer, self._newest, self.fault = sender, {}, ""
        self._again = True
        if self._greeting != sender:
            self._greet = sender
        self.pending.set()

    def _refuse(self, why: str) -> None:
        self.refusals += 1
        if self._peer == NO_SENDER:
            self.fault = why or self.fault

    def _seal(self, topic: str, receiver: bytes, count: int, data: bytes) -> bytes:
        code = self._code(topic, self._me, receiver, count, data)
        return HEAD.pack(MARK, self._me, receiver, count, code) + data

    def _code(self, topic: str, sender: bytes, receiver: bytes, count: int, data: bytes) -> bytes:
        return self._key.sign(MARK, self._vehicle, topic.encode(), sender, receiver, count.to_bytes(8, "little"), data)
