"""A ROS 1 node that receives a vehicle's state and publishes attitude targets on the mavros topics.

This module does not decide which pilot flies; :mod:`.plant` does.
"""

import io
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from ..plants.bridges.ros_states import RosStates
from ..plants.bridges.target_guardian import RATES_IGNORED, TargetGuardian, level
from .attitude_target import attitude_target
from .node import join, system_module

ODOMETRY, POSE, TARGET = "local_position/odom", "local_position/pose", "setpoint_raw/attitude"
RATES_ONLY = 128  # type_mask of an AttitudeTarget: ignore the attitude


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
        self._words = master, f"{namespace}/{TARGET}"
        self._rospy, self._target = rospy, attitude_target()
        odometry, pose = system_module("nav_msgs.msg").Odometry, system_module("geometry_msgs.msg").PoseStamped
        self._ends = [
            rospy.Subscriber(f"{namespace}/{topic}", kind, _with_stamp(take), queue_size=1, tcp_nodelay=True)
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

    def target_guardian(self) -> TargetGuardian:
        """Start a guardian with a node of its own."""
        return TargetGuardian("retrim.ros1.relay", self._words)

    def level_target(self, thrust: float, yaw: float) -> bytes:
        """Return a serialised AttitudeTarget.

        Args:
            thrust: Share of the motors' thrust, 0 to 1.
            yaw: Heading of the level attitude [rad].
        """
        target, data = self._target(), io.BytesIO()
        target.header.stamp = self._rospy.Time.from_sec(time.time())
        target.type_mask, target.thrust = RATES_IGNORED, thrust
        target.orientation.z, target.orientation.w = level(yaw)
        target.serialize(data)
        return data.getvalue()

    def close(self) -> None:
        """Unregister from the topics; the node exists until the process ends."""
        for end in self._ends:
            end.unregister()


def _with_stamp(take: Callable[[Any, float], None]) -> Callable[[Any], None]:
    """Return a callback that also passes the stamp of a message."""
    return lambda message: take(message, message.header.stamp.to_sec())
