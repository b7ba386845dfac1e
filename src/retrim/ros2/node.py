"""The interface of a ROS 2 node: it publishes and subscribes to typed messages, as CDR bytes."""

import abc
import os
from collections.abc import Callable, Mapping, Sequence
from typing import ClassVar, NamedTuple

from ..errors import ConfigError
from .message_type import NO_HASH, MessageType, title_by_hash

LARGEST_DOMAIN = 232
Publish = Callable[[bytes], None]
"""Publishes a message, given as CDR bytes with the header; any thread may call it."""
Take = Callable[[bytes], None]
"""Receives a message, as CDR bytes with the header; called in a thread of the node, one message at a time."""


class Qos(NamedTuple):
    """Quality of service. A subscriber receives only from publishers with at least its own quality."""

    reliable: bool = False
    """Whether lost messages are sent again."""
    keeps_last: bool = False
    """Whether late subscribers receive the last message."""
    depth: int = 1
    """Number of messages that wait for a slow reader."""


SENSOR = Qos()
"""Best effort, volatile, newest message only: PX4 requests this for its inputs. It is compatible with PX4's outputs
(best effort, transient local) and with every other publisher."""
COMMAND = Qos(reliable=True)
"""Reliable, volatile: every subscriber accepts it."""
LATCHED = Qos(reliable=True, keeps_last=True)
"""Reliable, with the last message for late subscribers."""


class Endpoint(NamedTuple):
    """A publisher or subscription of another node."""

    type_name: str
    """Name of the message type, such as ``nav_msgs/msg/Odometry``."""
    type_hash: str
    """Hash of the type; empty if the node does not report it, as with micro-XRCE-DDS and with releases before Iron."""
    publishes: bool
    """Whether it publishes."""


class Ros2Node(abc.ABC):
    """A node of one back end. The callbacks of all subscriptions run one at a time."""

    backend: ClassVar[str]
    """Name of the back end."""

    @abc.abstractmethod
    def advertise(self, topic: str, kind: MessageType, qos: Qos) -> Publish:
        """Return the function that publishes on a topic.

        Args:
            topic: Absolute name, such as ``/fmu/in/vehicle_command``.
            kind: Type of the messages.
            qos: Quality of service that is offered.

        Raises:
            ConfigError: The back end has no such type, or has it in another version.
        """

    @abc.abstractmethod
    def subscribe(self, topic: str, kind: MessageType, qos: Qos, take: Take) -> None:
        """Call a function with each message of a topic.

        Args:
            topic: Absolute name.
            kind: Type of the messages.
            qos: Quality of service that is requested.
            take: Called with the bytes of a message.

        Raises:
            ConfigError: The back end has no such type, or has it in another version.
        """

    @abc.abstractmethod
    def endpoints(self, topic: str) -> Sequence[Endpoint]:
        """Return the publishers and subscriptions that other nodes have on a topic, as far as they are discovered."""

    @abc.abstractmethod
    def published_topics(self) -> Mapping[str, str]:
        """Return the topics on which other nodes publish, as far as they are discovered, with the types of ROS."""

    @abc.abstractmethod
    def close(self) -> None:
        """Leave the network; idempotent."""


def domain_id() -> int:
    """Return the domain of this process, from ``ROS_DOMAIN_ID``.

    Raises:
        ConfigError: The variable is not a domain.
    """
    text = os.environ.get("ROS_DOMAIN_ID", "") or "0"
    if not text.isascii() or not text.isdigit() or int(text) > LARGEST_DOMAIN:
        raise ConfigError(f"ROS_DOMAIN_ID={text[:40]!r}: expected a number from 0 to 232")
    return int(text)


def is_local() -> bool:
    """Return whether only nodes on this machine should be found."""
    if os.environ.get("ROS_LOCALHOST_ONLY", "0") == "1":
        return True
    return os.environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "SUBNET").upper() == "LOCALHOST"


def mismatches(topic: str, kind: MessageType, endpoints: Sequence[Endpoint]) -> list[str]:
    """Return a sentence for each endpoint whose type differs from the type of this end.

    Args:
        topic: Name of the topic.
        kind: Type that this end has.
        endpoints: Endpoints of other nodes.
    """
    result = []
    for each in endpoints:
        if each.type_name != kind.name:
            result.append(f"{topic} is {each.type_name} at the other end, and {kind.name} here")
        elif each.type_hash not in ("", NO_HASH, kind.hash):
            result.append(
                f"{topic}: {kind.name} is that of {title_by_hash(kind.name, each.type_hash)} at the other end, and of "
                f"{kind.title} here"
            )
    return list(dict.fromkeys(result))


def ros_name(dds_name: str) -> str:
    """Return the ROS name of a type from its name in DDS; other names are returned unchanged."""
    parts = dds_name.split("::")
    if len(parts) == 4 and parts[2] == "dds_" and parts[3].endswith("_"):
        return f"{parts[0]}/{parts[1]}/{parts[3][:-1]}"
    return dds_name


def check_topic(topic: str) -> None:
    """Raise :class:`ConfigError` if a topic is not an absolute name of ROS."""
    parts = topic.split("/")
    fine = topic.isascii() and len(parts) > 1 and not parts[0]
    if not fine or not all(part.isidentifier() for part in parts[1:]):
        raise ConfigError(f"topic {topic[:80]!r}: expected an absolute name, such as /mavros/local_position/odom")
