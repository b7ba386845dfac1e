"""A bus by ROS 1, the paper's transport: latched topics of bytes, and a rosmaster that knows who is where.

rospy comes with the system (Debian: ``python3-rospy``), not from a package index; no other file imports it.
"""

import os
import socket
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from urllib.parse import urlparse

from ..errors import ConfigError
from .network import NetworkBus

SYSTEM = Path("/usr/lib/python3/dist-packages")
"""Where Debian puts packages; a virtual environment does not look there."""
PREFIX = "/retrim"


class RosBus(NetworkBus):
    """One end of the bus. Ends in one process share its node, which lives as long as the process."""

    def __init__(self, capacities: Mapping[str, int], master: str) -> None:
        """Join a bus.

        Args:
            capacities: Longest message of each topic [bytes].
            master: Where the rosmaster is, as ``http://127.0.0.1:11311``.

        Raises:
            ConfigError: rospy is not installed, or there is no master.
        """
        address = urlparse(master)
        try:
            socket.create_connection((address.hostname or "", address.port or 11311), 5.0).close()
        except OSError as error:
            raise ConfigError(f"ROS: no rosmaster at {master!r} ({error})") from error
        os.environ["ROS_MASTER_URI"] = master
        if address.hostname in ("127.0.0.1", "localhost"):  # otherwise its sockets listen everywhere
            os.environ["ROS_IP"] = "127.0.0.1"
        rospy, message = _rospy()
        super().__init__(capacities)
        self._rospy, self._message = rospy, message
        rospy.init_node("retrim", anonymous=True, disable_signals=True, disable_rosout=True, disable_rostime=True)
        self._publishers: dict[str, Any] = {}
        self._subscribers = [
            rospy.Subscriber(_name(topic), message, self._listener(topic), queue_size=1, tcp_nodelay=True,
                             buff_size=64 + 2 * capacity)
            for topic, capacity in capacities.items()
        ]  # fmt: skip

    def close(self) -> None:
        """Leave the bus."""
        for each in (*self._subscribers, *self._publishers.values()):
            each.unregister()

    def _send(self, topic: str, frame: bytes) -> None:
        if topic not in self._publishers:
            self._publishers[topic] = self._rospy.Publisher(
                _name(topic), self._message, queue_size=1, latch=True, tcp_nodelay=True
            )
        self._publishers[topic].publish(data=frame)

    def _listener(self, topic: str) -> Any:
        return lambda message: self._received(topic, bytes(message.data))


def _rospy() -> tuple[Any, Any]:
    """Return rospy and the type of messages; the system's packages come after ours."""
    if str(SYSTEM) not in sys.path and SYSTEM.is_dir():
        sys.path.append(str(SYSTEM))
    try:
        import rospy
        from std_msgs.msg import UInt8MultiArray
    except ImportError as error:
        raise ConfigError(f"a bus by ROS 1 needs rospy from the system: apt install python3-rospy ({error})") from error
    return rospy, UInt8MultiArray


def _name(topic: str) -> str:
    return f"{PREFIX}/{topic.replace('.', '/')}"
