"""The simulated peer that has PX4's own topics in ROS 2."""

import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from ..config.scenario import Scenario
from ..plants.bridges import frames
from ..ros2.definitions import NEWEST
from ..ros2.message_type import px4_hash
from ..ros2.node import SENSOR, Ros2Node
from .peer_vehicle import GROUND
from .ros2_mavros_peer import Habits, Ros2Peer

FAILSAFE_S = 1.0  # [s]: time without a setpoint until the failsafe
PX4 = "px4_msgs/msg"
OFFBOARD, HOLD, LAND = "offboard", "hold", "land"
SET_MODE, ARM = 176, 400  # MAV_CMD


class Px4Peer(Ros2Peer):
    """The part of PX4 that :mod:`retrim` needs: arming, offboard mode, both kinds of setpoints, landing, failsafe."""

    def __init__(
        self, node: Ros2Node, scenario: Scenario, habits: Habits, *, release: str = NEWEST, namespace: str = "",
        reports_thrust: bool = False, answers: bool = True,
    ) -> None:  # fmt: skip
        """Build a vehicle on the ground at the origin, with the nose to the north.

        Args:
            node: Node through which messages are exchanged.
            scenario: Plant, vehicle and disturbance.
            habits: How the state is published.
            release: Release of PX4 whose messages are used.
            namespace: Prefix of the topics.
            reports_thrust: Whether the peer publishes its thrust, which PX4 does not do by default.
            answers: Whether the peer answers questions about the formats of its inputs.
        """
        super().__init__(node, scenario, habits, heading=math.pi / 2, release=release)
        self.mode, self.armed = HOLD, False
        self._rates: np.ndarray | None = None
        self._wants_rates = False
        self._place, self._yaw, self._setpoint_time = np.zeros(3), math.pi / 2, -math.inf
        self._reports_thrust, self._answers = reports_thrust, answers
        names = {
            "vehicle_odometry": "VehicleOdometry", "vehicle_control_mode": "VehicleControlMode",
            "vehicle_thrust_setpoint": "VehicleThrustSetpoint", "message_format_response": "MessageFormatResponse",
        }  # fmt: skip
        self._out = {
            topic: self.advertise(f"{namespace}/fmu/out/{topic}", f"{PX4}/{name}", SENSOR)
            for topic, name in names.items()
            if topic != "vehicle_thrust_setpoint" or reports_thrust
        }
        takes: dict[str, tuple[str, Callable[[Any], None]]] = {
            "vehicle_rates_setpoint": ("VehicleRatesSetpoint", self._take_rates),
            "trajectory_setpoint": ("TrajectorySetpoint", self._take_place),
            "offboard_control_mode": ("OffboardControlMode", self._take_wish),
            "vehicle_command": ("VehicleCommand", self._take_command),
            "message_format_request": ("MessageFormatRequest", self._take_question),
        }
        self._inputs = {f"/fmu/in/{topic}": name for topic, (name, _) in takes.items()}
        for topic, (name, take) in takes.items():
            self.subscribe(f"{namespace}/fmu/in/{topic}", f"{PX4}/{name}", take)

    @property
    def by_rates(self) -> bool:
        """Whether the vehicle flies with externally commanded thrust and body rates."""
        return self.vehicle.flies and self.mode == OFFBOARD and self._wants_rates and self._rates is not None

    def advance(self) -> None:
        """Fly by setpoints, hold the position, or land."""
        vehicle = self.vehicle
        if not vehicle.flies:
            if self.armed:
                vehicle.lift_off()
            return
        if self.mode == OFFBOARD and time.monotonic() - self._setpoint_time > FAILSAFE_S:
            self.mode, self._place, self._rates = HOLD, vehicle.p.copy(), None
            vehicle.forget()
        if self.mode == LAND:
            self._place = np.array([*self._place[:2], max(vehicle.p[2] - 0.3, -0.5)])
        rates = self._rates if self.by_rates else None
        u = vehicle.towards(self._place, self._yaw) if rates is None else rates
        self.thrust = float(u[0]) / vehicle.thrust_max
        vehicle.step(u)
        if self.mode == LAND and vehicle.p[2] < GROUND:
            vehicle.flies = self.armed = False

    def report(self) -> None:
        """Publish the mode, and the thrust."""
        offboard = self.mode == OFFBOARD
        self._send("vehicle_control_mode", flag_armed=self.armed, flag_control_offboard_enabled=offboard)
        if self._reports_thrust and self.vehicle.flies:
            self._send("vehicle_thrust_setpoint", xyz=np.array([0.0, 0.0, -self.thrust], np.float32))

    def publish(self, p: np.ndarray) -> None:
        """Publish odometry, with velocities in the world frame."""
        x, kind = self.vehicle, self._out["vehicle_odometry"][0]
        if "pose_frame" not in {name for name, _ in kind.store.fielddefs[kind.name][1]}:
            self._send("vehicle_odometry")  # in the older form, whose content does not matter
            return
        self._send(
            "vehicle_odometry", timestamp_sample=self.habits.now_ns() // 1000, pose_frame=1, velocity_frame=1,
            position=frames.turn_world(p).astype(np.float32), q=frames.quaternion_of(x.R).astype(np.float32),
            velocity=frames.turn_world(x.v).astype(np.float32),
            angular_velocity=frames.turn_body(x.omega).astype(np.float32),
        )  # fmt: skip

    def _send(self, topic: str, **values: Any) -> None:
        kind, publish = self._out[topic]
        message = kind.new()
        message.timestamp = self.habits.now_ns() // 1000
        for name, value in values.items():
            setattr(message, name, value)
        data = kind.encode(message)
        if topic == "vehicle_odometry":
            self.habits.send(publish, data)
        else:
            publish(data)

    def _take_rates(self, m: Any) -> None:
        omega = frames.turn_body(np.array([m.roll, m.pitch, m.yaw]))
        self._rates = np.concatenate([[-m.thrust_body[2] * self.vehicle.thrust_max], omega])
        self._setpoint_time = time.monotonic()
        self.engage()

    def _take_place(self, m: Any) -> None:
        if self.mode == OFFBOARD or not self.vehicle.flies:
            self._place = frames.turn_world(np.asarray(m.position, float))
            self._yaw = frames.turn_heading(float(m.yaw))
        self._setpoint_time = time.monotonic()

    def _take_wish(self, m: Any) -> None:
        self._wants_rates = bool(m.body_rate)

    def _take_command(self, m: Any) -> None:
        if m.command == SET_MODE:
            fresh = time.monotonic() - self._setpoint_time < FAILSAFE_S
            if m.param2 == 6 and fresh:
                self.mode = OFFBOARD
            elif (m.param2, m.param3) == (4, 6):
                self.mode, self._place = LAND, self.vehicle.p.copy()
        elif m.command == ARM:
            self.armed = bool(m.param1)

    def _take_question(self, m: Any) -> None:
        topic = bytes(np.asarray(m.topic_name, np.uint8)).split(b"\0")[0].decode()
        if self._answers:
            known = topic in self._inputs
            value = px4_hash(f"{PX4}/{self._inputs[topic]}", self.release) if known else 0
            self._send(
                "message_format_response",
                protocol_version=1,
                topic_name=m.topic_name,
                success=known,
                message_hash=value,
            )
