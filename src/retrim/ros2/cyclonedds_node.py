"""A ROS 2 node by Cyclone DDS from the package index, which talks to every node that uses DDS."""

import os
import socket
import threading
from collections.abc import Mapping, Sequence
from typing import Any

from ..errors import ConfigError
from .cyclonedds_types import idl_type, without_description
from .message_type import MessageType
from .node import Endpoint, Publish, Qos, Ros2Node, Take, check_topic, domain_id, is_local, ros_name

PARTICIPANTS = 32  # nodes of one machine that are searched without multicast
WAIT_MS = 50  # [ms] until the thread looks whether the node was closed
HASH_KEY = "typehash="
_MAKING = threading.Lock()


class CycloneNode(Ros2Node):
    """A participant of a DDS domain.

    ``CYCLONEDDS_URI`` configures it, as in ROS. Without this variable, ``ROS_AUTOMATIC_DISCOVERY_RANGE`` and
    ``ROS_STATIC_PEERS`` decide where other nodes are searched.
    """

    backend = "cyclonedds"

    def __init__(self, domain_number: int | None = None) -> None:
        """Join the domain.

        Args:
            domain_number: Domain of ROS; None for the one of ``ROS_DOMAIN_ID``.

        Raises:
            ConfigError: Cyclone DDS is not installed, or cannot join the domain.
        """
        try:
            from cyclonedds import builtin, core, domain
        except ImportError as error:
            raise ConfigError("ROS 2 by Cyclone DDS needs cyclonedds: pip install cyclonedds") from error
        os.environ.setdefault("CYCLONEDDS_URI", configuration())
        try:
            self._participant = domain.DomainParticipant(domain_id() if domain_number is None else domain_number)
        except Exception as error:  # its errors derive from Exception
            raise ConfigError(f"ROS 2 by Cyclone DDS: cannot join the domain ({error}); see CYCLONEDDS_URI") from error
        self._core, self._wait = core, core.WaitSet(self._participant)
        self._builtin = [
            (builtin.BuiltinDataReader(self._participant, topic), publishes)
            for topic, publishes in (
                (builtin.BuiltinTopicDcpsPublication, True), (builtin.BuiltinTopicDcpsSubscription, False)
            )
        ]  # fmt: skip
        self._me = str(self._participant.guid)
        self._readers: list[tuple[Any, Any, Take]] = []
        self._topics: dict[tuple[str, str], Any] = {}
        self._over = threading.Event()
        self._thread: threading.Thread | None = None

    def advertise(self, topic: str, kind: MessageType, qos: Qos) -> Publish:
        """Return the function that publishes on a topic."""
        from cyclonedds.pub import DataWriter

        place = self._topic(topic, kind)
        with _MAKING, without_description(place):
            writer = DataWriter(self._participant, place, qos=self._qos(kind, qos))
        raw = place.data_type

        def publish(data: bytes) -> None:
            writer.write(raw.of_bytes(data))

        return publish

    def subscribe(self, topic: str, kind: MessageType, qos: Qos, take: Take) -> None:
        """Call a function with each message of a topic."""
        from cyclonedds.sub import DataReader

        core = self._core
        place = self._topic(topic, kind)
        with _MAKING, without_description(place):
            reader = DataReader(self._participant, place, qos=self._qos(kind, qos))
        mask = core.ViewState.Any | core.InstanceState.Any | core.SampleState.NotRead
        condition = core.ReadCondition(reader, mask)
        self._readers = [*self._readers, (reader, condition, take)]
        self._wait.attach(condition)
        if self._thread is None:
            self._thread = threading.Thread(target=self._receive, daemon=True)
            self._thread.start()

    def endpoints(self, topic: str) -> Sequence[Endpoint]:
        """Return the publishers and subscriptions that other nodes have on a topic."""
        policies = self._core.Policy
        result = []
        for sample, publishes in self._announcements():
            if sample.topic_name == f"rt{topic}":
                text = sample.qos[policies.Userdata].data if policies.Userdata in sample.qos else b""
                fields = text.decode("ascii", "replace").split(";")
                type_hash = next((each[len(HASH_KEY) :] for each in fields if each.startswith(HASH_KEY)), "")
                result.append(Endpoint(ros_name(sample.type_name), type_hash, publishes))
        return result

    def published_topics(self) -> Mapping[str, str]:
        """Return the topics on which other nodes publish."""
        publishers = [sample for sample, publishes in self._announcements() if publishes]
        return {
            each.topic_name.removeprefix("rt"): ros_name(each.type_name)
            for each in publishers
            if each.topic_name.startswith("rt/")
        }

    def close(self) -> None:
        """Leave the domain."""
        self._over.set()
        if self._thread is not None:
            self._thread.join(1.0)
        self._readers, self._builtin, self._topics = [], [], {}
        self._participant, self._wait = None, None

    def _announcements(self) -> list[tuple[Any, bool]]:
        """Return the endpoints of other participants, and whether each of them publishes."""
        return [
            (sample, publishes)
            for reader, publishes in self._builtin
            for sample in reader.read(1000)
            if getattr(sample, "topic_name", "") and str(sample.participant_key) != self._me
        ]

    def _receive(self) -> None:
        from cyclonedds.util import duration

        timeout = duration(milliseconds=WAIT_MS)
        while not self._over.is_set():
            self._wait.wait(timeout)
            for reader, _, take in self._readers:
                for sample in reader.take(100):
                    if isinstance(sample, bytes):  # otherwise it reports that a publisher has left
                        take(bytes(sample))

    def _topic(self, topic: str, kind: MessageType) -> Any:
        from cyclonedds.topic import Topic

        check_topic(topic)
        key = (topic, kind.hash)
        if key not in self._topics:
            self._topics[key] = Topic(self._participant, f"rt{topic}", idl_type(kind))
        return self._topics[key]

    def _qos(self, kind: MessageType, qos: Qos) -> Any:
        policies = self._core.Policy
        reliable = policies.Reliability.Reliable(max_blocking_time=100_000_000)  # [ns], as ROS has it
        return self._core.Qos(
            reliable if qos.reliable else policies.Reliability.BestEffort,
            policies.Durability.TransientLocal if qos.keeps_last else policies.Durability.Volatile,
            policies.History.KeepLast(qos.depth),
            policies.Userdata(f"{HASH_KEY}{kind.hash};".encode()),
        )


def configuration() -> str:
    """Return the configuration that the ROS variables describe, as XML."""
    local = is_local()
    peers = ["127.0.0.1"] if local else []
    peers += [peer.strip() for peer in os.environ.get("ROS_STATIC_PEERS", "").split(";") if peer.strip()]
    for peer in peers:
        if not all(sign.isalnum() or sign in "-.:[]" for sign in peer):
            raise ConfigError(f"ROS_STATIC_PEERS: {peer[:40]!r} is not an address of a machine")
    if local:
        interfaces = '<NetworkInterface name="lo" multicast="true"/>'
    else:  # otherwise it would take any interface, which need not be the one that leads to the peers
        interfaces = "".join(
            f'<NetworkInterface address="{each}"/>' for each in sorted(set(map(_way_to, peers))) if each
        )
    interfaces = interfaces and f"<Interfaces>{interfaces}</Interfaces>"
    peer_list = "".join(f'<Peer address="{peer}"/>' for peer in peers)
    return (
        f'<CycloneDDS><Domain id="any"><General>{interfaces}</General><Discovery><ParticipantIndex>auto'
        f"</ParticipantIndex><MaxAutoParticipantIndex>{PARTICIPANTS}</MaxAutoParticipantIndex><Peers>{peer_list}</Peers>"
        "</Discovery></Domain></CycloneDDS>"
    )


def _way_to(peer: str) -> str:
    """Return the address of this machine's interface that leads to a peer; empty if there is none."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect((peer, 7400))  # sends no packet
            return str(probe.getsockname()[0])
        except (OSError, TypeError):  # TypeError: an impossible name
            return ""
