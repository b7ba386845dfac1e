"""Carry topics between two buses, so that control processes never access a network."""

import time
from collections.abc import Callable, Iterable, Mapping

from ..errors import MessageError
from .bus import Bus

EVERY = 0.05  # shortest time between two messages of a throttled topic [s]


class Bridge:
    """Connects two buses, with one direction for each topic; both buses keep only the last message of a topic."""

    def __init__(
        self,
        here: Bus,
        there: Bus,
        *,
        out: Iterable[str],
        into: Iterable[str],
        slowly: Iterable[str] = (),
        known: Mapping[str, int] | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Build a bridge.

        Args:
            here: First bus.
            there: Second bus.
            out: Topics carried from ``here`` to ``there``.
            into: Topics carried from ``there`` to ``here``.
            slowly: Topics that are published more often than necessary; at most one message per ``EVERY`` seconds is
                carried.
            known: Version of each topic up to which messages are not carried; None to carry every message.
            clock: Monotonic clock [s].
        """
        self._routes = [(here, there, topic) for topic in out] + [(there, here, topic) for topic in into]
        self._slowly, self._clock = frozenset(slowly), clock
        self.known = {topic: 0 for _, _, topic in self._routes} | dict(known or {})
        """Version of each topic up to which messages have been carried."""
        self._carried = dict.fromkeys(self._slowly, float("-inf"))
        self.refused = 0
        """Number of messages that the other bus rejected."""

    def step(self) -> int:
        """Carry new messages; return their number."""
        carried = 0
        for source, target, topic in self._routes:
            if topic in self._slowly and self._clock() - self._carried[topic] < EVERY:
                continue
            message = source.latest(topic, self.known[topic])
            if message is None:
                continue
            self.known[topic] = message.version
            self._carried[topic] = self._clock()
            try:
                target.publish(topic, message.data)
            except MessageError:
                self.refused += 1
            else:
                carried += 1
        return carried
