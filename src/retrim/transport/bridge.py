"""Carries topics between two buses, so that those who fly never touch a network."""

import time
from collections.abc import Callable, Iterable, Mapping

from ..errors import MessageError
from .bus import Bus

EVERY = 0.05  # [s] between two messages of a topic that is carried now and then


class Bridge:
    """Between a bus and another, one direction for each topic; only the last message counts, here as there."""

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
            here: One bus.
            there: The other one.
            out: Topics from here to there.
            into: Topics from there to here.
            slowly: Those of them that come more often than anybody needs; at most one in ``EVERY`` is carried.
            known: Version of a topic up to which nothing is carried; None: whatever is there is carried.
            clock: Monotonic [s].
        """
        self._routes = [(here, there, topic) for topic in out] + [(there, here, topic) for topic in into]
        self._slowly, self._clock = frozenset(slowly), clock
        self.known = {topic: 0 for _, _, topic in self._routes} | dict(known or {})
        """Version of each topic up to which it is carried."""
        self._carried = dict.fromkeys(self._slowly, float("-inf"))
        self.refused = 0
        """Messages that did not fit."""

    def step(self) -> int:
        """Carry what is new; return how many messages that were."""
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
