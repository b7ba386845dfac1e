"""A ROS 1 node that receives a vehicle's state and publishes attitude targets on the mavros topics.

This module does not decide which pilot flies; :mod:`.ros` does.
"""

import math
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from ...rospy_node import join, system_module
from .clock import ArrivalClock
from .vehicle_state import Reading

ODOMETRY, POSE, TARGET = "local_position/odom", "local_position/pose", "setpoint_raw/attitude"
RATES_ONLY = 128  # type_mask of an AttitudeTarget: ignore the attitude
FRESH_S = 0.5  # [s] without odometry, after which poses are used instead
SMOOTH_S = 0.03  # [s] over which velocities from differences of poses are smoothed
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


class RosLink:
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
        self._rospy, self._target = rospy, attitude_target()
        self._clock, self._odometry_at, self._stamp = ArrivalClock(), -math.inf, 0.0
        self._one_at_a_time = threading.Lock()
        self.reading: Reading | None = None
        self.last_message = -math.inf
        """Time of the last valid state, on the monotonic clock [s]."""
        self.ignored = 0
        """Number of invalid states."""
        odometry, pose = system_module("nav_msgs.msg").Odometry, system_module("geometry_msgs.msg").PoseStamped
        self._ends = [
            rospy.Subscriber(f"{namespace}/{topic}", kind, self._alone(take), queue_size=1, tcp_nodelay=True)
            for topic, kind, take in ((ODOMETRY, odometry, self._odometry), (POSE, pose, self._pose))
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

    def _alone(self, take: Callable[[Any], None]) -> Callable[[Any], None]:
        """Return a callback that waits for the callbacks of other topics, which run in other threads."""

        def take_message(message: Any) -> None:
            with self._one_at_a_time:
                take(message)

        return take_message

    def _odometry(self, message: Any) -> None:
        """Process nav_msgs/Odometry: pose in its frame, twist in its child frame (the body, unless both are equal)."""
        twist, pose = message.twist.twist, message.pose.pose
        v, omega = (np.array([a.x, a.y, a.z]) for a in (twist.linear, twist.angular))
        result = _pose(pose)
        if result is None or not np.isfinite(np.concatenate([v, omega])).all():
            self.ignored += 1
            return
        p, R = result
        self._odometry_at = time.monotonic()
        in_world = message.child_frame_id in ("", message.header.frame_id)
        self._take(message.header.stamp.to_sec(), p, R, v if in_world else R @ v, R.T @ omega if in_world else omega)

    def _pose(self, message: Any) -> None:
        """Process geometry_msgs/PoseStamped unless odometry is recent; velocities are smoothed differences of poses."""
        from scipy.spatial.transform import Rotation  # local, because it takes as long to import as all of retrim

        result, last = _pose(message.pose), self.reading
        if result is None:
            self.ignored += 1
            return
        if time.monotonic() - self._odometry_at < FRESH_S:
            return
        p, R = result
        stamp = message.header.stamp.to_sec()
        if last is None or not 1e-4 < (dt := stamp - self._stamp) < FRESH_S:
            self._take(stamp, p, R, np.zeros(3), np.zeros(3))
            return
        new = dt / (dt + SMOOTH_S)
        v = last.v + new * ((p - last.p) / dt - last.v)
        omega = last.omega + new * (Rotation.from_matrix(last.R.T @ R).as_rotvec() / dt - last.omega)
        self._take(stamp, p, R, v, omega)

    def _take(self, stamp: float, p: np.ndarray, R: np.ndarray, v: np.ndarray, omega: np.ndarray) -> None:
        now = time.monotonic()
        self._clock.record_arrival(stamp, now)
        here = self._clock.here(stamp)
        assert here is not None
        if self.reading is None or here >= self.reading.stamp or now - self.last_message > FRESH_S:
            self.reading, self.last_message, self._stamp = Reading(here, p, R, v, omega), now, stamp


def _pose(pose: Any) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the position and attitude in a geometry_msgs/Pose; None if it is invalid."""
    from scipy.spatial.transform import Rotation  # local for the same reason

    p, q = pose.position, pose.orientation
    place, quaternion = np.array([p.x, p.y, p.z]), np.array([q.x, q.y, q.z, q.w])
    if not np.isfinite(np.concatenate([place, quaternion])).all() or not 0.5 < quaternion @ quaternion < 2.0:
        return None
    return place, Rotation.from_quat(quaternion).as_matrix()
