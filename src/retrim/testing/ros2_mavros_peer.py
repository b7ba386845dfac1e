"""Common parts of the simulated peers of ROS 2, and the peer with the topics of mavros."""

import abc
import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from ..config.scenario import Scenario
from ..ros2.definitions import NEWEST
from ..ros2.message_type import MessageType, message_type
from ..ros2.node import SENSOR, Publish, Qos, Ros2Node
from .peer_vehicle import DT, PeerVehicle

VALIDITY_S = 0.3  # [s]: time for which a target is valid
THRUST_PERIOD = 4  # ticks between two messages about thrust
ODOMETRY, POSE, TARGET = "nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped", "mavros_msgs/msg/AttitudeTarget"


class Habits:
    """How the peer publishes its state."""

    def __init__(
        self, rate: float = 100.0, *, scrambled: bool = False, jump: tuple[float, float] | None = None
    ) -> None:
        """Build habits.

        Args:
            rate: Rate of states [Hz].
            scrambled: Whether every second message overtakes the one before it.
            jump: Seconds after the first setpoint at which the clock is set, and by how much [s].
        """
        self.rate, self.scrambled, self.jump = rate, scrambled, jump
        self.engaged = math.inf
        """Time of the first setpoint, on the monotonic clock [s]."""
        self._kept: bytes | None = None

    @property
    def period(self) -> float:
        """Time between two calls of a peer's step [s]."""
        return min(DT, 1.0 / self.rate)

    def now_ns(self) -> int:
        """Return the time of the peer's clock [ns]."""
        is_set = self.jump is not None and time.monotonic() - self.engaged > self.jump[0]
        return time.time_ns() + (int(1e9 * self.jump[1]) if self.jump is not None and is_set else 0)

    def send(self, publish: Publish, data: bytes) -> None:
        """Publish a message in the peer's order."""
        if not self.scrambled:
            publish(data)
        elif self._kept is None:
            self._kept = data
        else:
            publish(data)
            publish(self._kept)
            self._kept = None


class Ros2Peer(abc.ABC):
    """A vehicle and its autopilot; :meth:`step` is called once every :attr:`Habits.period`."""

    def __init__(
        self, node: Ros2Node, scenario: Scenario, habits: Habits, *, heading: float = 0.0, release: str = NEWEST
    ) -> None:
        """Build a vehicle.

        Args:
            node: Node through which messages are exchanged.
            scenario: Plant, vehicle and disturbance.
            habits: How the state is published.
            heading: Heading on the ground [rad].
            release: Release of PX4 whose messages are used.
        """
        self.node, self.habits, self.release = node, habits, release
        self.vehicle = PeerVehicle(scenario, heading=heading)
        self._calls, self._tick, self.thrust = 0, 0, 0.0
        self.cut = False
        """Whether the network is cut in both directions."""

    def step(self) -> None:
        """Advance by a tick if one is due, and publish the state."""
        per_tick = round(DT / self.habits.period)
        if self._calls % per_tick == 0:
            self._tick += 1
            self.advance()
            if self._tick % THRUST_PERIOD == 0:
                self.report()
        later = (self._calls % per_tick) * self.habits.period
        every = max(1, round(1.0 / (self.habits.rate * self.habits.period)))
        if self._calls % every == 0:
            self.publish(self.vehicle.p + later * self.vehicle.v)
        self._calls += 1

    @abc.abstractmethod
    def advance(self) -> None:
        """Advance the vehicle by a tick."""

    def report(self) -> None:
        """Publish the slow messages; by default, there are none."""
        return

    @abc.abstractmethod
    def publish(self, p: np.ndarray) -> None:
        """Publish the state, at a position in the world frame [m]."""

    def advertise(self, topic: str, name: str, qos: Qos) -> tuple[MessageType, Publish]:
        """Advertise a topic."""
        kind = message_type(name, self.release)
        publish = self.node.advertise(topic, kind, qos)
        return kind, lambda data: None if self.cut else publish(data)

    def subscribe(self, topic: str, name: str, take: Callable[[Any], None]) -> None:
        """Subscribe to a topic."""
        kind = message_type(name, self.release)
        self.node.subscribe(topic, kind, SENSOR, lambda data: None if self.cut else take(kind.decode(data)))

    def engage(self) -> None:
        """Note the time of the first setpoint."""
        self.habits.engaged = min(self.habits.engaged, time.monotonic())


class MavrosPeer(Ros2Peer):
    """A vehicle behind mavros that another pilot has flown to the start."""

    def __init__(
        self, node: Ros2Node, scenario: Scenario, habits: Habits, *, place: np.ndarray, yaw: float,
        poses: bool = False, reports_thrust: bool = True, namespace: str = "/mavros", fresh: float = VALIDITY_S,
    ) -> None:  # fmt: skip
        """Build a vehicle that is about to take off.

        Args:
            node: Node through which messages are exchanged.
            scenario: Plant, vehicle and disturbance.
            habits: How the state is published.
            place: Position at which the vehicle waits, world [m].
            yaw: Heading with which the vehicle waits [rad].
            poses: Whether the peer publishes poses instead of odometry.
            reports_thrust: Whether the peer publishes the autopilot's thrust.
            namespace: Prefix of the topics.
            fresh: Time for which a target is valid [s]; some stacks hold the last one for ever.
        """
        super().__init__(node, scenario, habits)
        self.fresh = fresh
        """Time for which a target is valid [s]."""
        self._place, self._yaw, self._poses = place, yaw, poses
        self._target: Any = None
        self._target_time, self.by_rates = -math.inf, False
        """Whether the vehicle follows targets."""
        name = "pose" if poses else "odom"
        self._kind, self._publish = self.advertise(
            f"{namespace}/local_position/{name}", POSE if poses else ODOMETRY, SENSOR
        )
        self._message = self._kind.new()
        self._thrusts = self.advertise(f"{namespace}/setpoint_raw/target_attitude", TARGET, SENSOR)
        self._reports_thrust = reports_thrust
        self.subscribe(f"{namespace}/setpoint_raw/attitude", TARGET, self._hear)
        self.vehicle.lift_off()

    def advance(self) -> None:
        """Fly by targets, or hold the position."""
        fresh = time.monotonic() - self._target_time < self.fresh
        if self.by_rates and not fresh:
            self._place = self.vehicle.p.copy()
            self.vehicle.forget()
        self.by_rates = fresh
        u = self.vehicle.by_target(self._target) if fresh else self.vehicle.towards(self._place, self._yaw)
        self.thrust = float(u[0]) / self.vehicle.thrust_max
        self.vehicle.step(u)

    def report(self) -> None:
        """Publish the autopilot's thrust."""
        if self._reports_thrust:
            kind, publish = self._thrusts
            message = kind.new()
            message.thrust = self.thrust
            publish(kind.encode(message))

    def publish(self, p: np.ndarray) -> None:
        """Publish odometry or a pose."""
        from scipy.spatial.transform import Rotation  # local, because this import takes as long as that of retrim

        x, message = self.vehicle, self._message
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(self.habits.now_ns(), 10**9)
        message.header.frame_id = "map"
        pose = message.pose if self._poses else message.pose.pose
        pose.position.x, pose.position.y, pose.position.z = map(float, p)
        q = Rotation.from_matrix(x.R).as_quat()
        pose.orientation.x, pose.orientation.y, pose.orientation.z, pose.orientation.w = map(float, q)
        if not self._poses:
            message.child_frame_id = "base_link"
            twist, v = message.twist.twist, x.R.T @ x.v
            twist.linear.x, twist.linear.y, twist.linear.z = map(float, v)
            twist.angular.x, twist.angular.y, twist.angular.z = map(float, x.omega)
        self.habits.send(self._publish, self._kind.encode(message))

    def _hear(self, target: Any) -> None:
        self._target, self._target_time = target, time.monotonic()
        self.engage()
