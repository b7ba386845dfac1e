"""Carry topics between two buses, so that control processes never access a network."""

import time
from collections.abc import Callable, Iterable, Mapping

from ..errors import MessageError
from .bus import Bus

LEAST_INTERVAL = 0.05  # shortest time between two messages of a throttled topic [s]


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
        versions: Mapping[str, int] | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Build a bridge.

        Args:
            here: First bus.
            there: Second bus.
            out: Topics carried from ``here`` to ``there``.
            into: Topics carried from ``there`` to ``here``.
            slowly: Topics that are published more often than necessary; at most one message per ``LEAST_INTERVAL``
                seconds is carried.
            versions: Version of each topic up to which messages are not carried; None to carry every message.
            clock: Monotonic clock [s].
        """
        self._routes = [(here, there, topic) for topic in out] + [(there, here, topic) for topic in into]
        self._slowly, self._clock = frozenset(slowly), clock
        self.versions = {topic: 0 for _, _, topic in self._routes} | dict(versions or {})
        """Version of each topic up to which messages have been carried."""
        self._last_times = dict.fromkeys(self._slowly, float("-inf"))
        self.refusals = 0
        """Number of messages that the other bus rejected."""

    def step(self) -> int:
        """Carry new messages; return their number."""
        count = 0
        for source, target, topic in self._routes:
            if topic in self._slowly and self._clock() - self._last_times[topic] < LEAST_INTERVAL:
                continue
            message = source.latest(topic, self.versions[topic])
            if message is None:
                continue
            self.versions[topic] = message.version
            self._last_times[topic] = self._clock()
            try:
                target.publish(topic, message.data)
            except MessageError:
                self.refusals += 1
            else:
                count += 1
        return count
