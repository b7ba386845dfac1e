"""A conversation of two ends that share a key: whose messages are taken, and whose are not.

Each end draws a random number when it starts. A message names the number of its sender, that of the end that it is for,
and a count; HMAC-SHA256 covers all of them, the topic, the vehicle and the payload. An end takes a message only if it
names this end's own number and is newer than those before it. So neither a message of an earlier session nor one that
was taken already is taken again, even by an end that has just been started, and no clocks have to agree. Whoever hears
an end for the first time greets it with its number, and the last message of each topic is sent once more, for it.
"""

import hmac
import secrets
import struct
import threading
from typing import NamedTuple

from .shared_key import SharedKey

MARK = b"signed1\xff"
"""Beginning of every signed message: form and version. No unsigned one begins so."""
HEAD = struct.Struct("<8s16s16sQ32s")
"""Mark, sender, receiver, count, code."""
NOBODY = bytes(16)
GREETINGS = "greeting.flight", "greeting.ground"
"""Topics of those who listen, and of those who join them."""
UNSIGNED = "the other end has no key; start it with --key FILE or RETRIM_KEY, the same as here"
FOREIGN = "the other end has another key; --key FILE or RETRIM_KEY must be the same at both ends"
MISSING = "the other end has a key, and this one has none; start it with --key FILE or RETRIM_KEY"


class Due(NamedTuple):
    """What an end has to send."""

    greeting: bytes | None
    """A signed greeting; None for none."""
    again: bool
    """Whether the last message of each topic is sent once more."""


class Session:
    """One end of the conversation; it may be used by several threads."""

    def __init__(self, key: SharedKey, vehicle: str, greeting: str) -> None:
        """Begin one.

        Args:
            key: Shared with the other end.
            vehicle: Whose conversation it is, where several share a place.
            greeting: Topic in which this end greets the other one.
        """
        self.greeting = greeting
        self.fault = ""
        """Why messages are refused, while the other end has not been heard; empty once it is."""
        self.refused = 0
        """Messages that were not taken: forged, or taken before."""
        self.pending = threading.Event()
        """Set while anything is due."""
        self.pending.set()
        self._key, self._vehicle, self._me = key, vehicle.encode(), secrets.token_bytes(16)
        self._peer, self._former = NOBODY, set[bytes]()
        self._greet: bytes | None = NOBODY
        self._greeted: bytes | None = None
        self._again, self._greetings = False, 0
        self._newest = dict[str, int]()
        self._lock = threading.RLock()

    def seal(self, topic: str, count: int, data: bytes) -> bytes:
        """Return a message for the other end; counts of a topic rise."""
        return self._sealed(topic, self._peer, count, data)

    def open(self, topic: str, frame: bytes) -> tuple[int, bytes] | None:
        """Return count and payload of a message, if it is a new one of the other end for this one."""
        if not frame.startswith(MARK) or len(frame) < HEAD.size:
            self._refuse(UNSIGNED)
            return None
        _, sender, receiver, count, code = HEAD.unpack_from(frame)
        data = frame[HEAD.size :]
        if not hmac.compare_digest(code, self._code(topic, sender, receiver, count, data)):
            self._refuse(FOREIGN)
            return None
        with self._lock:
            if sender == self._me:  # an echo
                return None
            if sender in self._former:
                self._refuse("")
                return None
            if receiver != self._me:  # it may be old: its sender has to prove that it lives
                if self._greeted != sender:
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
        """Return what has to be sent now, once."""
        with self._lock:
            greet, again = self._greet, self._again
            self._greet, self._again = None, False
            self.pending.clear()
            if greet is None:
                return Due(None, again)
            self._greeted, self._greetings = greet, self._greetings + 1
            return Due(self._sealed(self.greeting, greet, self._greetings, b""), again)

    def _meet(self, sender: bytes) -> None:
        """Talk to an end that has named this one's number: it lives, and the one before it does not count any more."""
        if self._peer != NOBODY:
            self._former.add(self._peer)
        self._peer, self._newest, self.fault = sender, {}, ""
        self._again = True
        if self._greeted != sender:
            self._greet = sender
        self.pending.set()

    def _refuse(self, why: str) -> None:
        self.refused += 1
        if self._peer == NOBODY:
            self.fault = why or self.fault

    def _sealed(self, topic: str, receiver: bytes, count: int, data: bytes) -> bytes:
        code = self._code(topic, self._me, receiver, count, data)
        return HEAD.pack(MARK, self._me, receiver, count, code) + data

    def _code(self, topic: str, sender: bytes, receiver: bytes, count: int, data: bytes) -> bytes:
        return self._key.sign(MARK, self._vehicle, topic.encode(), sender, receiver, count.to_bytes(8, "little"), data)
