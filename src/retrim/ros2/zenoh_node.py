"""A ROS 2 node by zenoh, in the format of rmw_zenoh: it talks to nodes of rmw_zenoh and to PX4's zenoh module."""

import json
import secrets
import struct
import threading
import time
from collections.abc import Mapping, Sequence
from typing import Any

from ..errors import ConfigError
from .message_type import NO_HASH, MessageType
from .node import Endpoint, Publish, Qos, Ros2Node, Take, check_topic, domain_id, ros_name

ROUTER = "127.0.0.1:7447"
"""Address of the router of rmw_zenoh on this machine."""
ADMIN, NODE_NAME = "@ros2_lv", "retrim"
GID_BYTES = 16
ATTACHMENT = struct.Struct(f"<qqB{GID_BYTES}s")
"""Sequence number, time of publication [ns], and the number of the publisher with its length: rmw_zenoh since 0.2.4 in
Jazzy and 0.6 in Kilted."""
DISCOVERY_S = 0.5  # [s] for the answers about other nodes
RELIABLE, BEST_EFFORT, TRANSIENT_LOCAL = "", "2", "1"


class ZenohNode(Ros2Node):
    """A session with the router of rmw_zenoh, or with one other session."""

    backend = "zenoh"

    def __init__(self, address: str = ROUTER, *, listen: bool = False, domain: int | None = None) -> None:
        """Open a session.

        Args:
            address: ``HOST:PORT`` of the router.
            listen: Whether to wait at the address for others, in place of a router.
            domain: Domain of ROS; None for the one of ``ROS_DOMAIN_ID``.

        Raises:
            ConfigError: zenoh is not installed, or the address cannot be used.
        """
        try:
            import zenoh
        except ImportError as error:
            raise ConfigError("ROS 2 by zenoh needs zenoh: pip install eclipse-zenoh") from error
        self._zenoh: Any = zenoh
        self._session = open_session(f"tcp/{address}", listen, f"open a session at {address!r}")
        self._domain, self._count = domain_id() if domain is None else domain, 0
        self._me = str(self._session.zid())
        self._lock = threading.Lock()
        self._held: list[Any] = [self._token(f"{self._identity('NN', 0)}")]
        self.refusals = 0
        """Number of messages of another type or version."""

    def advertise(self, topic: str, kind: MessageType, qos: Qos) -> Publish:
        """Return the function that publishes on a topic."""
        check_topic(topic)
        block = self._zenoh.CongestionControl.BLOCK if qos.reliable else self._zenoh.CongestionControl.DROP
        publisher = self._session.declare_publisher(self.key(topic, kind), congestion_control=block)
        self._held += [publisher, self._announce("MP", topic, kind, qos)]
        gid, number = secrets.token_bytes(GID_BYTES), 0

        def publish(data: bytes) -> None:
            nonlocal number
            number += 1
            publisher.put(data, attachment=ATTACHMENT.pack(number, time.time_ns(), GID_BYTES, gid))

        return publish

    def subscribe(self, topic: str, kind: MessageType, qos: Qos, take: Take) -> None:
        """Call a function with each message of a topic."""
        check_topic(topic)

        def receive(sample: Any) -> None:
            parts = str(sample.key_expr).rsplit("/", 2)
            if parts[1] == kind.dds_name and parts[2] in (kind.hash, NO_HASH):
                with self._lock:
                    take(bytes(sample.payload))
            else:
                self.refusals += 1

        where = f"{self._domain}{topic}/*/*"  # also other versions, which are counted
        self._held += [self._session.declare_subscriber(where, receive), self._announce("MS", topic, kind, qos)]

    def endpoints(self, topic: str) -> Sequence[Endpoint]:
        """Return the publishers and subscriptions that other nodes have on a topic."""
        result = []
        for parts in self._announcements():
            if parts[9] == _mangle(topic):
                type_hash = "" if parts[11] == NO_HASH else parts[11]
                result.append(Endpoint(ros_name(parts[10]), type_hash, parts[5] == "MP"))
        return result

    def published_topics(self) -> Mapping[str, str]:
        """Return the topics on which other nodes publish."""
        publishers = [parts for parts in self._announcements() if parts[5] == "MP"]
        return {parts[9].replace("%", "/"): ros_name(parts[10]) for parts in publishers}

    def close(self) -> None:
        """Close the session."""
        if not self._session.is_closed():
            self._session.close()

    def key(self, topic: str, kind: MessageType) -> str:
        """Return the key of a topic."""
        return f"{self._domain}{topic}/{kind.dds_name}/{kind.hash}"

    def _announcements(self) -> list[list[str]]:
        """Return the parts of the tokens of other nodes' publishers and subscriptions."""
        replies = self._session.liveliness().get(f"{ADMIN}/{self._domain}/**", timeout=DISCOVERY_S)
        tokens = [str(reply.ok.key_expr).split("/") for reply in replies if reply.ok is not None]
        return [each for each in tokens if len(each) == 13 and each[2] != self._me and each[5] in ("MP", "MS")]

    def _token(self, key: str) -> Any:
        return self._session.liveliness().declare_token(key)

    def _identity(self, what: str, number: int) -> str:
        return f"{ADMIN}/{self._domain}/{self._me}/0/{number}/{what}/%/%/{NODE_NAME}"

    def _announce(self, what: str, topic: str, kind: MessageType, qos: Qos) -> Any:
        """Declare that this end publishes or subscribes, so that the tools of ROS list it."""
        self._count += 1
        reliability = RELIABLE if qos.reliable else BEST_EFFORT
        durability = TRANSIENT_LOCAL if qos.keeps_last else ""
        profile = f"{reliability}:{durability}:,{qos.depth}:,:,:,,"
        identity = self._identity(what, self._count)
        return self._token(f"{identity}/{_mangle(topic)}/{kind.dds_name}/{kind.hash}/{profile}")


def open_session(endpoint: str, listen: bool, action: str) -> Any:
    """Open a session of zenoh without a broker or discovery: one end listens, and the others connect.

    Args:
        endpoint: Endpoint, for example ``tcp/192.168.1.5:7447``.
        listen: Whether to wait at the endpoint for others; otherwise, the session connects without a time limit.
        action: Action in the error message.

    Raises:
        ConfigError: The endpoint cannot be used.
    """
    import zenoh

    config = zenoh.Config()
    for name, value in {
        "mode": "peer",
        "scouting/multicast/enabled": False,
        "timestamping/enabled": True,  # required by the history for late subscribers
        "listen/endpoints": [endpoint] if listen else [],
        "connect/endpoints": [] if listen else [endpoint],
        "connect/timeout_ms": -1,
        "connect/exit_on_failure": False,
        # With these times, a returning peer is reconnected quickly.
        "connect/retry": {"period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 2},
    }.items():
        config.insert_json5(name, json.dumps(value))
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        raise ConfigError(f"zenoh: cannot {action} ({str(error).splitlines()[0].split(' at ')[0]})") from error


def _mangle(topic: str) -> str:
    return topic.replace("/", "%")
