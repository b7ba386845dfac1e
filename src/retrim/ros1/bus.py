"""Provide a bus over ROS 1, the paper's transport, with latched topics of bytes and a rosmaster."""

from collections.abc import Iterable, Mapping
from typing import Any

from ..transport.network import NetworkBus
from ..transport.session import Session
from .node import join, system_module

PREFIX = "/retrim"


class RosBus(NetworkBus):
    """One end of the bus. Ends in one process share one node, which lives as long as the process."""

    def __init__(
        self,
        capacities: Mapping[str, int],
        master: str,
        *,
        key: str = "",
        writes: Iterable[str] = (),
        session: Session | None = None,
    ) -> None:
        """Join a bus.

        Args:
            capacities: Maximum length of a message, by topic [bytes].
            master: URI of the rosmaster, for example ``http://127.0.0.1:11311``.
            key: Key that selects one vehicle among several.
            writes: Topics that this end writes; others are declared with their first message.
            session: Signs messages; None if messages are not signed.

        Raises:
            ConfigError: rospy is not installed, or there is no master.
        """
        rospy, message = join(master), system_module("std_msgs.msg").UInt8MultiArray
        super().__init__(capacities, session)
        self._rospy, self._message = rospy, message
        self._prefix = f"{PREFIX}/{key}" if key else PREFIX
        self._publishers: dict[str, Any] = {}
        self._subscribers = [
            rospy.Subscriber(self._name(topic), message, self._listener(topic), queue_size=1, tcp_nodelay=True,
                             buff_size=64 + 2 * capacity)
            for topic, capacity in capacities.items()
        ]  # fmt: skip
        for topic in writes:
            self._declare(topic)
        self._begin()

    def close(self) -> None:
        """Leave the bus."""
        self._end()
        for each in (*self._subscribers, *self._publishers.values()):
            each.unregister()

    def _send(self, topic: str, frame: bytes) -> None:
        if topic not in self._publishers:
            self._declare(topic)
        self._publishers[topic].publish(data=frame)

    def _declare(self, topic: str) -> None:
        self._publishers[topic] = self._rospy.Publisher(
            self._name(topic), self._message, queue_size=1, latch=True, tcp_nodelay=True
        )

    def _listener(self, topic: str) -> Any:
        return lambda message: self._receive(topic, bytes(message.data))

    def _name(self, topic: str) -> str:
        return f"{self._prefix}/{topic.replace('.', '/')}"
