"""Read a vehicle's state from nav_msgs/Odometry and geometry_msgs/PoseStamped, whose fields ROS 1 and ROS 2 share."""

import math
import threading
import time
from typing import Any

import numpy as np

from .clock import StampClock
from .pose_velocities import PoseVelocities
from .vehicle_state import Reading

ODOMETRY_TIMEOUT_S = 0.5  # [s] without odometry, after which poses are used instead
RATE_WINDOW_S = 1.0  # [s] over which the rate of states is counted
MOST_NOTES = 5


class RosStates:
    """Keeps the newest state; messages may be taken in any thread."""

    def __init__(self) -> None:
        self._clock, self._velocities = StampClock(), PoseVelocities()
        self._odometry_at = -math.inf
        self._arrivals: list[float] = []
        self._one_at_a_time = threading.Lock()
        self.reading: Reading | None = None
        self.last_message = -math.inf
        """Time of the last valid state, on the monotonic clock [s]."""
        self.ignored = 0
        """Number of invalid states."""
        self.notes: list[str] = []
        """Kinds of ignored messages, each listed once."""

    @property
    def rate(self) -> float:
        """Rate of states over the last second [Hz]."""
        now = time.monotonic()
        return len([t for t in self._arrivals if now - t < RATE_WINDOW_S]) / RATE_WINDOW_S

    def ignore(self, what: str = "") -> None:
        """Count a message that cannot be used, and note its kind once."""
        self.ignored += 1
        if what and what not in self.notes and len(self.notes) < MOST_NOTES:
            self.notes.append(what)

    def take_odometry(self, message: Any, stamp: float) -> None:
        """Take nav_msgs/Odometry: pose in its frame, twist in its child frame (the body, unless both are equal)."""
        twist, pose = message.twist.twist, message.pose.pose
        v, omega = (np.array([a.x, a.y, a.z]) for a in (twist.linear, twist.angular))
        result = pose_of(pose)
        if result is None or not np.isfinite(np.concatenate([v, omega])).all():
            self.ignore("odometry with values that are not finite, or without an attitude")
            return
        p, R = result
        self._odometry_at = time.monotonic()
        in_world = message.child_frame_id in ("", message.header.frame_id)
        self.take(stamp, p, R, v if in_world else R @ v, R.T @ omega if in_world else omega)

    def take_pose(self, message: Any, stamp: float) -> None:
        """Take geometry_msgs/PoseStamped unless odometry is recent; velocities are derived from the last poses."""
        result, now = pose_of(message.pose), time.monotonic()
        if result is None:
            self.ignore("a pose with values that are not finite, or without an attitude")
        elif now - self._odometry_at >= ODOMETRY_TIMEOUT_S:
            self.take(stamp, *result)

    def take(
        self, stamp: float, p: np.ndarray, R: np.ndarray, v: np.ndarray | None = None, omega: np.ndarray | None = None
    ) -> None:
        """Take a state in our frames; without velocities, they are derived from the last poses.

        Args:
            stamp: Time at which the state was valid, on the sender's clock [s]; 0 if it is unknown.
            p: Position in the world frame [m].
            R: Attitude, body to world.
            v: Velocity in the world frame [m/s].
            omega: Body rates [rad/s].
        """
        with self._one_at_a_time:
            now, jumps = time.monotonic(), self._clock.jumps
            here = self._clock.here(stamp, now)
            if here is None:
                return
            if self._clock.jumps > jumps:
                self._velocities.restart()
            if v is None or omega is None:
                v, omega = self._velocities.update(here, p, R)
            self._arrivals = [t for t in self._arrivals if now - t < RATE_WINDOW_S] + [now]
            self.reading, self.last_message = Reading(here, p, R, v, omega), now


def pose_of(pose: Any) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the position and attitude in a geometry_msgs/Pose; None if it is invalid."""
    from scipy.spatial.transform import Rotation  # local for the same reason

    p, q = pose.position, pose.orientation
    place, quaternion = np.array([p.x, p.y, p.z]), np.array([q.x, q.y, q.z, q.w])
    if not np.isfinite(np.concatenate([place, quaternion])).all() or not 0.5 < quaternion @ quaternion < 2.0:
        return None
    return place, Rotation.from_quat(quaternion).as_matrix()
