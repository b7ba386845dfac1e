"""Provide a bus over ROS 2: topics of bytes whose last message reaches late subscribers, in one domain."""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from ..errors import MessageError
from ..ros2.backends import open_node
from ..ros2.message_type import message_type
from ..ros2.node import LATCHED, Publish
from .network import NetworkBus
from .session import Session

PREFIX = "/retrim"
BYTES = "std_msgs/msg/UInt8MultiArray"


class Ros2Bus(NetworkBus):
    """One end of the bus, which finds the others by the discovery of DDS."""

    def __init__(
        self,
        capacities: Mapping[str, int],
        domain: int,
        *,
        key: str = "",
        writes: Iterable[str] = (),
        session: Session | None = None,
    ) -> None:
        """Join a bus.

        Args:
            capacities: Maximum length of a message, by topic [bytes].
            domain: Domain of ROS.
            key: Key that selects one vehicle among several.
            writes: Topics that this end writes; others are declared with their first message.
            session: Signs messages; None if messages are not signed.

        Raises:
            ConfigError: No back end of ROS 2 is installed, or the domain cannot be joined.
        """
        super().__init__(capacities, session)
        self._kind = message_type(BYTES)
        self._node = open_node("", ("std_msgs",), domain=domain)
        self._prefix = f"{PREFIX}/{key}" if key else PREFIX
        self._publishers: dict[str, Publish] = {}
        for topic in writes:
            self._declare(topic)
        for topic in capacities:
            self._node.subscribe(self._name(topic), self._kind, LATCHED, self._listener(topic))
        self._begin()

    def close(self) -> None:
        """Leave the bus."""
        self._end()
        self._node.close()

    def _send(self, topic: str, frame: bytes) -> None:
        if topic not in self._publishers:
            self._declare(topic)
        message = self._kind.new()
        message.data = np.frombuffer(frame, np.uint8)
        self._publishers[topic](self._kind.encode(message))

    def _declare(self, topic: str) -> None:
        self._publishers[topic] = self._node.advertise(self._name(topic), self._kind, LATCHED)

    def _listener(self, topic: str) -> Any:
        def receive(data: bytes) -> None:
            try:
                frame = self._kind.decode(data).data
            except MessageError:
                self._refusals += 1
            else:
                self._receive(topic, bytes(frame))

        return receive

    def _name(self, topic: str) -> str:
        return f"{self._prefix}/{name_of(topic)}"


def name_of(topic: str) -> str:
    """Return the name of a topic in ROS, whose parts must not begin with a digit."""
    return "/".join(f"n{part}" if part[0].isdigit() else part for part in topic.split("."))
