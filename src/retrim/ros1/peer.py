"""Simulate a vehicle with ROS 1 and the plant ``bem``, for tests and trials of a node.

``python -m retrim.ros1.peer http://127.0.0.1:11311 --disturbance large`` runs until Ctrl-C. The vehicle
flies to the start. It follows attitude targets while the peer receives them, and holds its position when they stop. The
peer publishes odometry or only poses.
"""

import argparse
import math
import time
from typing import Any

import numpy as np

from ..config.scenario import Scenario
from ..errors import exit_on_error
from ..testing.peer_vehicle import PeerVehicle, fly_until_interrupt
from .attitude_target import attitude_target
from .link import ODOMETRY, POSE, TARGET
from .node import join, system_module
from .plant import NAMESPACE

VALIDITY_S = 0.3  # [s]: time for which a target is valid


class RosPeer:
    """A vehicle and its autopilot; :meth:`step` advances both by 0.01 s."""

    def __init__(
        self, master: str, scenario: Scenario, *, place: np.ndarray, yaw: float, poses: bool = False,
        fresh: float = VALIDITY_S,
    ) -> None:  # fmt: skip
        """Build a vehicle that is about to take off.

        Args:
            master: URI of the rosmaster.
            scenario: Plant, vehicle and disturbance.
            place: Position at which the vehicle waits, world [m].
            yaw: Heading with which the vehicle waits [rad].
            poses: Whether the peer publishes poses instead of odometry.
            fresh: Time for which a target is valid [s]; some stacks hold the last one for ever.
        """
        self.fresh, self.cut = fresh, False
        """Time for which a target is valid [s], and whether the network is cut in both directions."""
        rospy = join(master)
        self._rospy, self._poses = rospy, poses
        self._kind = system_module("geometry_msgs.msg").PoseStamped if poses else system_module("nav_msgs.msg").Odometry
        self._publisher = rospy.Publisher(
            f"{NAMESPACE}/{POSE if poses else ODOMETRY}", self._kind, queue_size=1, tcp_nodelay=True
        )
        rospy.Subscriber(f"{NAMESPACE}/{TARGET}", attitude_target(), self._hear, queue_size=1, tcp_nodelay=True)
        self.vehicle = PeerVehicle(scenario, heading=0.0)
        self._place, self._yaw = place, yaw
        self._target: Any = None
        self._last_command_time, self.by_rates = -math.inf, False
        """Whether the vehicle follows targets."""
        self.vehicle.lift_off()

    def step(self) -> None:
        """Advance by a tick, and publish the state."""
        fresh = time.monotonic() - self._last_command_time < self.fresh
        if self.by_rates and not fresh:
            self._place = self.vehicle.p.copy()
            self.vehicle.forget()
        self.by_rates = fresh
        vehicle = self.vehicle
        vehicle.step(vehicle.by_target(self._target) if fresh else vehicle.towards(self._place, self._yaw))
        if not self.cut:
            self._say()

    def _hear(self, target: Any) -> None:
        if not self.cut:
            self._target, self._last_command_time = target, time.monotonic()

    def _say(self) -> None:
        from scipy.spatial.transform import Rotation  # local, because this import takes as long as that of retrim

        x, message = self.vehicle, self._kind()
        message.header.stamp = self._rospy.Time.from_sec(time.time())
        message.header.frame_id = "map"
        pose = message.pose if self._poses else message.pose.pose
        pose.position.x, pose.position.y, pose.position.z = map(float, x.p)
        q = Rotation.from_matrix(x.R).as_quat()
        pose.orientation.x, pose.orientation.y, pose.orientation.z, pose.orientation.w = map(float, q)
        if not self._poses:
            message.child_frame_id = "base_link"
            twist, v = message.twist.twist, x.R.T @ x.v
            twist.linear.x, twist.linear.y, twist.linear.z = map(float, v)
            twist.angular.x, twist.angular.y, twist.angular.z = map(float, x.omega)
        self._publisher.publish(message)


@exit_on_error
def main() -> None:
    """Fly until Ctrl-C."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("master", help="where the rosmaster is, as http://127.0.0.1:11311")
    parser.add_argument("--disturbance", default="none", help="as for `retrim fly`")
    parser.add_argument("--plant", default="bem", help="as for `retrim fly`")
    parser.add_argument("--place", type=float, nargs=3, default=(0.0, 0.0, 1.0), help="where it waits [m]")
    parser.add_argument("--yaw", type=float, default=0.0, help="its heading there [rad]")
    parser.add_argument("--poses", action="store_true", help="poses alone, no odometry")
    options = parser.parse_args()
    scenario = Scenario(options.disturbance, options.plant)
    peer = RosPeer(options.master, scenario, place=np.array(options.place), yaw=options.yaw, poses=options.poses)
    fly_until_interrupt(peer.step, f"it is at {options.master}")


if __name__ == "__main__":
    main()
