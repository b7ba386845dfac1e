"""A ROS 2 node that receives a vehicle's state and publishes setpoints.

This module does not decide which pilot flies; :mod:`.ros2` does.
"""

import time
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np

from ...errors import MessageError
from ...ros2.message_type import MessageType, message_type
from ...ros2.node import COMMAND, SENSOR, Endpoint, Publish, Qos, Ros2Node, mismatches
from .ros2_address import Ros2Address
from .ros_states import RosStates
from .target_guardian import RATES_IGNORED, TargetGuardian, level
from .vehicle_state import Reading

ODOMETRY, POSE = "nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped"
ATTITUDE_TARGET = "mavros_msgs/msg/AttitudeTarget"
RATES_ONLY = 128  # type_mask of an AttitudeTarget: ignore the attitude
NANO = 1e-9


class Ros2Link(RosStates):
    """Subscribes to states; the callbacks run in a thread of the node."""

    def __init__(self, node: Ros2Node, address: Ros2Address) -> None:
        """Build a link.

        Args:
            node: Node through which messages are exchanged; the link closes it.
            address: Topics and types.
        """
        super().__init__()
        self.node, self.address = node, address
        self.thrusts: deque[float] = deque(maxlen=50)
        """The autopilot's thrust commands to its motors, as shares of the full thrust, if they are published."""
        self.truth: Reading | None = None
        self._kinds: dict[str, MessageType] = {}
        self.inputs: list[str] = []
        """Topics on which this end publishes, and which must have a listener."""
        self.states: list[str] = []
        """Topics of which at least one must carry the state."""

    def listen(self, topic: str, name: str, take: Callable[[Any], None], *, state: bool = False) -> None:
        """Subscribe to a topic.

        Args:
            topic: Absolute name.
            name: Name of the message type.
            take: Called with each message.
            state: Whether the topic carries the state.
        """
        kind = self._kind(topic, name)
        if state:
            self.states.append(topic)

        def receive(data: bytes) -> None:
            try:
                message = kind.decode(data)
            except MessageError as error:
                self.ignore(str(error))
            else:
                take(message)

        self.node.subscribe(topic, kind, SENSOR, receive)

    def speak(self, topic: str, name: str, qos: Qos, *, needed: bool = True) -> tuple[MessageType, Publish]:
        """Advertise a topic; return the type and the function that publishes."""
        kind = self._kind(topic, name)
        if needed:
            self.inputs.append(topic)
        return kind, self.node.advertise(topic, kind, qos)

    def listen_to_states(self, odometry: str, pose: str) -> None:
        """Subscribe to the states in the types of ROS; an empty name leaves one out."""
        if odometry:
            self.listen(odometry, ODOMETRY, lambda x: self.take_odometry(x, stamp_of(x)), state=True)
        if pose:
            self.listen(pose, POSE, lambda x: self.take_pose(x, stamp_of(x)), state=True)

    def faults(self) -> list[str]:
        """Return a sentence for each topic whose type differs between the two ends, as far as they are discovered."""
        return [text for topic, kind in self._kinds.items() for text in mismatches(topic, kind, self._others(topic))]

    def topics_without_listener(self) -> list[str]:
        """Return the topics on which this end publishes without a listener."""
        return [topic for topic in self.inputs if not any(not each.publishes for each in self._others(topic))]

    def topics_with_several_publishers(self) -> list[str]:
        """Return the state topics on which more than one node publishes."""
        return [topic for topic in self.states if sum(each.publishes for each in self._others(topic)) > 1]

    def pump(self, until: float) -> None:
        """Wait until an instant on the monotonic clock [s]; messages are received in another thread."""
        time.sleep(max(0.0, until - time.monotonic()))

    def close(self) -> None:
        """Leave the network."""
        self.node.close()

    def _kind(self, topic: str, name: str) -> MessageType:
        self._kinds[topic] = message_type(name, self.address.release)
        return self._kinds[topic]

    def _others(self, topic: str) -> list[Endpoint]:
        return list(self.node.endpoints(topic))


class MavrosLink(Ros2Link):
    """The topics of mavros; its frames are those of ROS, as are ours."""

    def __init__(self, node: Ros2Node, address: Ros2Address) -> None:
        """Build a link.

        Args:
            node: Node through which messages are exchanged; the link closes it.
            address: Topics and types.

        Raises:
            ConfigError: The node has no such type, or has it in another version.
        """
        super().__init__(node, address)
        own = not (address.odometry or address.pose)
        self.listen_to_states(
            address.topic("local_position/odom") if own else address.odometry,
            address.topic("local_position/pose") if own else address.pose,
        )
        self.listen(address.topic("setpoint_raw/target_attitude"), ATTITUDE_TARGET, self._take_target)
        kind, self._publish = self.speak(address.topic("setpoint_raw/attitude"), ATTITUDE_TARGET, COMMAND)
        self._type, self._target = kind, kind.new()
        self._target.type_mask, self._target.orientation.w = RATES_ONLY, 1.0

    def fly_rates(self, thrust: float, omega: np.ndarray) -> None:
        """Publish an AttitudeTarget.

        Args:
            thrust: Share of the motors' thrust, 0 to 1.
            omega: Body rates in our frame, which is the ROS frame: forward, left, up [rad/s].
        """
        target, rate = self._target, self._target.body_rate
        target.header.stamp.sec, target.header.stamp.nanosec = divmod(time.time_ns(), 10**9)
        target.thrust = float(thrust)
        rate.x, rate.y, rate.z = map(float, omega)
        self._publish(self._type.encode(target))

    def target_guardian(self) -> TargetGuardian:
        """Start a guardian with a node of its own, by the same back end."""
        topic = self.address.topic("setpoint_raw/attitude")
        words = (self.node.backend, self.address.router, topic, ATTITUDE_TARGET)
        return TargetGuardian("retrim.ros2.relay", words)

    def level_target(self, thrust: float, yaw: float) -> bytes:
        """Return a serialised AttitudeTarget.

        Args:
            thrust: Share of the motors' thrust, 0 to 1.
            yaw: Heading of the level attitude [rad].
        """
        target = self._type.new()
        target.header.stamp.sec, target.header.stamp.nanosec = divmod(time.time_ns(), 10**9)
        target.type_mask, target.thrust = RATES_IGNORED, thrust
        target.orientation.z, target.orientation.w = level(yaw)
        return self._type.encode(target)

    def _take_target(self, target: Any) -> None:
        if np.isfinite(target.thrust):
            self.thrusts.append(float(target.thrust))


def stamp_of(message: Any) -> float:
    """Return the time in a message's header [s]."""
    stamp = message.header.stamp
    return float(stamp.sec) + NANO * float(stamp.nanosec)
