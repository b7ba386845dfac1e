"""A ROS 2 node by the user's own ROS, which needs the packages of all message types."""

import importlib
import itertools
import os
import threading
from collections.abc import Mapping, Sequence
from typing import Any

from ..errors import ConfigError
from .message_type import NO_HASH, MessageType
from .node import Endpoint, Publish, Qos, Ros2Node, Take, check_topic, mismatches

NUMBERS = itertools.count()
HASH_PREFIX = "RIHS01_"
CLOSE_PERIOD_S = 0.05  # [s] until the thread looks whether the node was closed


class RclpyNode(Ros2Node):
    """A node of rclpy with its own context; messages are published and received in serialised form."""

    backend = "rclpy"

    def __init__(self, domain: int | None = None) -> None:
        """Join the network as the middleware of the user's ROS is configured.

        Args:
            domain: Domain of ROS; None for the one of ``ROS_DOMAIN_ID``.

        Raises:
            ConfigError: rclpy cannot be imported or started.
        """
        try:
            import rclpy
            from rclpy import executors, qos
        except ImportError as error:
            raise ConfigError(f"rclpy cannot be imported ({error}); source the setup file of ROS 2") from error
        self._qos_module = qos
        self._context = rclpy.context.Context()
        try:
            rclpy.init(
                args=[], context=self._context, domain_id=domain, signal_handler_options=rclpy.SignalHandlerOptions.NO
            )
            self._name = f"retrim_{os.getpid()}_{next(NUMBERS)}"
            self._node: Any = rclpy.create_node(
                self._name, context=self._context, enable_rosout=False, start_parameter_services=False
            )
        except Exception as error:  # rclpy raises various errors
            raise ConfigError(f"rclpy cannot be started ({type(error).__name__}: {error})") from error
        self._executor = executors.SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._over = threading.Event()
        self._thread: threading.Thread | None = None

    def advertise(self, topic: str, kind: MessageType, qos: Qos) -> Publish:
        """Return the function that publishes on a topic."""
        check_topic(topic)
        publisher = self._node.create_publisher(_class_of(kind), topic, self._profile(qos))
        self._check_installed(topic, kind)
        return lambda data: publisher.publish(data)

    def subscribe(self, topic: str, kind: MessageType, qos: Qos, take: Take) -> None:
        """Call a function with each message of a topic."""
        check_topic(topic)
        self._node.create_subscription(_class_of(kind), topic, take, self._profile(qos), raw=True)
        self._check_installed(topic, kind)
        if self._thread is None:
            self._thread = threading.Thread(target=self._spin, daemon=True)
            self._thread.start()
        else:
            self._executor.wake()

    def endpoints(self, topic: str) -> Sequence[Endpoint]:
        """Return the publishers and subscriptions that other nodes have on a topic."""
        return [each for each, node in self._endpoints(topic) if node != self._name]

    def published_topics(self) -> Mapping[str, str]:
        """Return the topics on which other nodes publish."""
        names = [topic for topic, _ in self._node.get_topic_names_and_types()]
        publishers_of = {topic: [each for each in self.endpoints(topic) if each.publishes] for topic in names}
        return {topic: publishers[0].type_name for topic, publishers in publishers_of.items() if publishers}

    def close(self) -> None:
        """Leave the network."""
        if self._over.is_set():
            return
        self._over.set()
        self._executor.wake()
        if self._thread is not None:
            self._thread.join(1.0)
        self._executor.shutdown(1.0)
        self._node.destroy_node()
        self._context.try_shutdown()

    def _spin(self) -> None:
        while not self._over.is_set() and self._context.ok():
            self._executor.spin_once(timeout_sec=CLOSE_PERIOD_S)

    def _endpoints(self, topic: str) -> list[tuple[Endpoint, str]]:
        """Return all endpoints of a topic, with the names of their nodes."""
        result = []
        for publishes, infos in (
            (True, self._node.get_publishers_info_by_topic(topic)),
            (False, self._node.get_subscriptions_info_by_topic(topic)),
        ):
            for info in infos:
                type_hash = str(getattr(info, "topic_type_hash", ""))
                type_hash = (
                    type_hash if type_hash.startswith(HASH_PREFIX) and type_hash.strip("0") != HASH_PREFIX else NO_HASH
                )
                result.append((Endpoint(info.topic_type, type_hash, publishes), info.node_name))
        return result

    def _check_installed(self, topic: str, kind: MessageType) -> None:
        """Raise an error if the installed package has the type in another version."""
        mine = [each for each, node in self._endpoints(topic) if node == self._name]
        for text in mismatches(topic, kind, mine):
            raise ConfigError(f"{text.replace('at the other end', 'in this installation of ROS')}")

    def _profile(self, qos: Qos) -> Any:
        policies = self._qos_module
        reliable, best_effort = policies.ReliabilityPolicy.RELIABLE, policies.ReliabilityPolicy.BEST_EFFORT
        keeps, volatile = policies.DurabilityPolicy.TRANSIENT_LOCAL, policies.DurabilityPolicy.VOLATILE
        return policies.QoSProfile(
            depth=qos.depth,
            reliability=reliable if qos.reliable else best_effort,
            durability=keeps if qos.keeps_last else volatile,
        )


def _class_of(kind: MessageType) -> Any:
    package, middle, short = kind.name.split("/")
    try:
        return getattr(importlib.import_module(f"{package}.{middle}"), short)
    except (ImportError, AttributeError) as error:
        raise ConfigError(
            f"this installation of ROS 2 has no {kind.name}; install {package}, or choose another back end, as "
            "ros2:cyclonedds:"
        ) from error
