"""Addresses of vehicles behind ROS 2, such as ``ros2:cyclonedds:mavros/quad1/mavros``."""

import re
from typing import NamedTuple

from ...errors import ConfigError, excerpt
from ...ros2.backends import BACKENDS
from ...ros2.definitions import NEWEST
from ...ros2.node import check_topic

FORM = "[BACKEND[@HOST:PORT]:][px4|mavros][/NAMESPACE][,odometry=/TOPIC|,pose=/TOPIC]"
ADDRESS = re.compile(
    rf"((?P<backend>{'|'.join(BACKENDS)})(@(?P<router>[\w.-]+:\d{{1,5}}))?(:|$))?"
    r"(?P<dialect>px4|mavros)?(-(?P<release>\d+\.\d+))?(?P<namespace>(/\w+)*)(,(?P<kind>odometry|pose)=(?P<topic>/[\w/]+))?"
)
PACKAGES = {"px4": ("px4_msgs",), "mavros": ("mavros_msgs",)}
COMMON = ("nav_msgs", "geometry_msgs", "std_msgs")


class Ros2Address(NamedTuple):
    """Place of a vehicle, and its topics."""

    backend: str
    """Back end of the node; empty to choose one."""
    router: str
    """HOST:PORT of a zenoh router; empty for the default."""
    dialect: str
    """``px4`` or ``mavros``."""
    release: str
    """Release of PX4 whose messages are used."""
    namespace: str
    """Prefix of the topics."""
    odometry: str = ""
    """Topic of nav_msgs/Odometry with the state, in place of the topic of the dialect."""
    pose: str = ""
    """Topic of geometry_msgs/PoseStamped with the state."""

    @property
    def packages(self) -> tuple[str, ...]:
        """Packages of the message types."""
        own_state = not (self.odometry or self.pose) and self.dialect == "px4"
        return PACKAGES[self.dialect] + (() if own_state else COMMON)

    def topic(self, name: str) -> str:
        """Return the absolute name of a topic in the namespace."""
        return f"{self.namespace}/{name}"


def address_of(text: str) -> Ros2Address:
    """Return the parts of an address.

    Raises:
        ConfigError: The text is not an address.
    """
    result = ADDRESS.fullmatch(text)
    if result is None or (result["router"] and result["backend"] != "zenoh"):
        raise ConfigError(f"address {excerpt(text)}: expected ros2:{FORM}; a HOST:PORT is for zenoh only")
    dialect = result["dialect"] or "px4"
    if result["release"] and (dialect != "px4" or result["release"] < "1.14" or len(result["release"]) != 4):
        raise ConfigError(f"address {excerpt(text)}: a release follows px4, from px4-1.14 on")
    namespace = result["namespace"] or ("/mavros" if dialect == "mavros" else "")
    topics = {result["kind"]: result["topic"]} if result["kind"] else {}
    for topic in (f"{namespace}/x", *topics.values()):
        check_topic(topic)
    return Ros2Address(
        result["backend"] or "", result["router"] or "", dialect, result["release"] or NEWEST, namespace, **topics
    )
