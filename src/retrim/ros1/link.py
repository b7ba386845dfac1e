"""A ROS 1 node that receives a vehicle's state and publishes attitude targets on the mavros topics.

This module does not decide which pilot flies; :mod:`.plant` does.
"""

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from ..plants.bridges.ros_states import RosStates
from .node import join, system_module

ODOMETRY, POSE, TARGET = "local_position/odom", "local_position/pose", "setpoint_raw/attitude"
RATES_ONLY = 128  # type_mask of an AttitudeTarget: ignore the attitude
ATTITUDE_TARGET = """std_msgs/Header header
uint8 type_mask
uint8 IGNORE_ROLL_RATE = 1
uint8 IGNORE_PITCH_RATE = 2
uint8 IGNORE_YAW_RATE = 4
uint8 IGNORE_THRUST = 64
uint8 IGNORE_ATTITUDE = 128
geometry_msgs/Quaternion orientation
geometry_msgs/Vector3 body_rate
float32 thrust
================================================================================
MSG: std_msgs/Header
uint32 seq
time stamp
string frame_id
================================================================================
MSG: geometry_msgs/Quaternion
float64 x
float64 y
float64 z
float64 w
================================================================================
MSG: geometry_msgs/Vector3
float64 x
float64 y
float64 z
"""
"""Fields of mavros_msgs/AttitudeTarget; nodes compare their checksum. Debian does not provide mavros."""


def attitude_target() -> Any:
    """Return the type mavros_msgs/AttitudeTarget.

    Raises:
        ConfigError: genpy is not installed.
    """
    message_class = system_module("genpy.dynamic").generate_dynamic("mavros_msgs/AttitudeTarget", ATTITUDE_TARGET)
    return message_class["mavros_msgs/AttitudeTarget"]


class RosLink(RosStates):
    """Subscribes to odometry and poses, and publishes attitude targets; callbacks run in rospy threads."""

    def __init__(self, master: str, namespace: str) -> None:
        """Join the ROS network.

        Args:
            master: Address of the rosmaster, for example ``http://127.0.0.1:11311``.
            namespace: Prefix of the topic names, for example ``/mavros``.

        Raises:
            ConfigError: ROS is not installed, or the master is not running.
        """
        rospy = join(master)
        super().__init__()
        self._rospy, self._target = rospy, attitude_target()
        odometry, pose = system_module("nav_msgs.msg").Odometry, system_module("geometry_msgs.msg").PoseStamped
        self._ends = [
            rospy.Subscriber(f"{namespace}/{topic}", kind, _stamped(take), queue_size=1, tcp_nodelay=True)
            for topic, kind, take in ((ODOMETRY, odometry, self.take_odometry), (POSE, pose, self.take_pose))
        ]
        self._publisher = rospy.Publisher(f"{namespace}/{TARGET}", self._target, queue_size=1, tcp_nodelay=True)
        self._ends.append(self._publisher)

    def fly_rates(self, thrust: float, omega: np.ndarray) -> None:
        """Publish an AttitudeTarget.

        Args:
            thrust: Share of the motors' thrust, 0 to 1.
            omega: Body rates in our frame, which is the ROS frame: forward, left, up [rad/s].
        """
        target = self._target()
        target.header.stamp = self._rospy.Time.from_sec(time.time())
        target.type_mask, target.thrust, target.orientation.w = RATES_ONLY, float(thrust), 1.0
        target.body_rate.x, target.body_rate.y, target.body_rate.z = map(float, omega)
        self._publisher.publish(target)

    def close(self) -> None:
        """Unregister from the topics; the node exists until the process ends."""
        for end in self._ends:
            end.unregister()


def _stamped(take: Callable[[Any, float], None]) -> Callable[[Any], None]:
    """Return a callback that also passes the stamp of a message."""
    return lambda message: take(message, message.header.stamp.to_sec())
