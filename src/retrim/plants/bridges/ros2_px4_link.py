"""PX4's own topics in ROS 2: state, mode and answers from PX4, setpoints and commands to it.

PX4's world frame is north, east, down, and its body frame is forward, right, down.
"""

import math
import time
from collections import deque
from typing import Any

import numpy as np

from ...ros2.message_type import MessageType, message_type, px4_hash, title_by_px4_hash
from ...ros2.node import SENSOR, Publish, Ros2Node
from . import frames
from .ros2_address import Ros2Address
from .ros2_link import Ros2Link

PACKAGE = "px4_msgs/msg"
NED, FRD, BODY_FRD = 1, 2, 3  # frames of VehicleOdometry
OFFBOARD, OTHER = (6, 0), (0, 0)  # main and sub mode, as in MAVLink
PROTOCOL = 1  # of questions about formats
REQUEST_PERIOD_S, ANSWER_S = 0.2, 1.5  # [s] between two questions about a format, and limit for the answer
TOPICS = {
    "vehicle_rates_setpoint": "VehicleRatesSetpoint",
    "offboard_control_mode": "OffboardControlMode",
    "vehicle_command": "VehicleCommand",
    "trajectory_setpoint": "TrajectorySetpoint",
}
"""Inputs of PX4 that are used, with their types."""


class Px4Link(Ros2Link):
    """A connection to PX4 by its DDS client and agent, or by its zenoh module."""

    def __init__(self, node: Ros2Node, address: Ros2Address) -> None:
        """Build a link.

        Args:
            node: Node through which messages are exchanged; the link closes it.
            address: Topics and types.

        Raises:
            ConfigError: The node has no such type, or has it in another version.
        """
        super().__init__(node, address)
        self.mode, self.armed = OTHER, False
        self.texts: deque[str] = deque(maxlen=20)
        """Text messages, which PX4 does not publish in ROS."""
        self._answers: dict[str, tuple[bool, int]] = {}
        if address.odometry or address.pose:
            self.listen_to_states(address.odometry, address.pose)
        else:
            self.listen(self._out("vehicle_odometry"), f"{PACKAGE}/VehicleOdometry", self._take_px4, state=True)
        self.listen(self._out("vehicle_control_mode"), f"{PACKAGE}/VehicleControlMode", self._take_mode)
        self.listen(self._out("vehicle_thrust_setpoint"), f"{PACKAGE}/VehicleThrustSetpoint", self._take_thrust)
        self.listen(self._out("message_format_response"), f"{PACKAGE}/MessageFormatResponse", self._take_answer)
        self._ports: dict[str, tuple[MessageType, Publish, Any]] = {}
        for topic, name in TOPICS.items():
            self._open(topic, name, needed=True)
        self._open("message_format_request", "MessageFormatRequest", needed=False)

    def fly_rates(self, thrust: float, omega: np.ndarray) -> None:
        """Publish VehicleRatesSetpoint, and the control mode that it needs.

        Args:
            thrust: Share of the motors' thrust, 0 to 1.
            omega: Body rates in our frame [rad/s].
        """
        roll, pitch, yaw = map(float, frames.turn_body(omega))
        self._choose(body_rate=True)
        self._send(
            "vehicle_rates_setpoint", roll=roll, pitch=pitch, yaw=yaw,
            thrust_body=np.array([0.0, 0.0, -thrust], np.float32),
        )  # fmt: skip

    def fly_to(self, p: np.ndarray, yaw: float) -> None:
        """Publish TrajectorySetpoint, and the control mode that it needs.

        Args:
            p: Target position in our world frame [m].
            yaw: Target heading in our convention [rad].
        """
        unknown = np.full(3, np.nan, np.float32)
        self._choose(position=True)
        self._send(
            "trajectory_setpoint", position=frames.turn_world(p).astype(np.float32), velocity=unknown,
            acceleration=unknown, jerk=unknown, yaw=math.remainder(frames.turn_heading(yaw), math.tau),
            yawspeed=math.nan,
        )  # fmt: skip

    def command(self, number: int, *parameters: float) -> None:
        """Publish VehicleCommand, to any system and component."""
        values = (*parameters, *([0.0] * (7 - len(parameters))))
        values_by_name = {f"param{i}": float(value) for i, value in enumerate(values, 1)}
        self._send(
            "vehicle_command", command=number, source_system=1, source_component=1, from_external=True, **values_by_name
        )

    def format_fault(self, keep_on: Any = lambda: True) -> str:
        """Ask PX4 for the formats of its inputs; return a sentence if one differs, and note it if PX4 does not answer.

        Args:
            keep_on: Called repeatedly; the questions end when it returns False.
        """
        for topic, short in TOPICS.items():
            name, full = f"{PACKAGE}/{short}", f"/fmu/in/{topic}"
            until, last_request = time.monotonic() + ANSWER_S, -math.inf
            while full not in self._answers and time.monotonic() < until and keep_on():
                if time.monotonic() - last_request > REQUEST_PERIOD_S:
                    last_request = time.monotonic()
                    text = np.frombuffer(full.encode().ljust(50, b"\0"), np.uint8)
                    self._send("message_format_request", protocol_version=PROTOCOL, topic_name=text)
                self.pump(time.monotonic() + 0.01)
            if full not in self._answers:
                self.ignore("PX4 does not tell the formats of its inputs, so only lengths and hashes were compared")
                return ""
            known, value = self._answers[full]
            if not known:
                return f"PX4 has no input {full}; it is in PX4 from 1.14 on, unless dds_topics.yaml leaves it out"
            if value != px4_hash(name, self.address.release):
                title = message_type(name, self.address.release).title
                return (
                    f"{full}: {name} is that of {title_by_px4_hash(name, value)} in the firmware, and of {title} here"
                )
        return ""

    def _out(self, topic: str) -> str:
        return self.address.topic(f"fmu/out/{topic}")

    def _open(self, topic: str, name: str, *, needed: bool) -> None:
        kind, publish = self.speak(self.address.topic(f"fmu/in/{topic}"), f"{PACKAGE}/{name}", SENSOR, needed=needed)
        self._ports[topic] = kind, publish, kind.new()

    def _send(self, topic: str, **values: Any) -> None:
        kind, publish, message = self._ports[topic]
        message.timestamp = time.time_ns() // 1000
        for name, value in values.items():
            setattr(message, name, value)
        publish(kind.encode(message))

    def _choose(self, *, position: bool = False, body_rate: bool = False) -> None:
        self._send("offboard_control_mode", position=position, body_rate=body_rate)

    def _take_px4(self, x: Any) -> None:
        if x.pose_frame not in (NED, FRD):
            self.ignore(f"VehicleOdometry in frame {x.pose_frame}; only NED (1) and FRD (2) are known")
            return
        if x.velocity_frame not in (NED, FRD, BODY_FRD):
            self.ignore(f"VehicleOdometry with velocities in frame {x.velocity_frame}; only 1, 2 and 3 are known")
            return
        p, q, v, rates = (np.asarray(a, float) for a in (x.position, x.q, x.velocity, x.angular_velocity))
        if not np.isfinite(np.concatenate([p, q, v, rates])).all() or not 0.5 < q @ q < 2.0:
            self.ignore("VehicleOdometry with values that are not finite, or without an attitude")
            return
        R = frames.attitude_of(q)
        velocity = R @ frames.turn_body(v) if x.velocity_frame == BODY_FRD else frames.turn_world(v)
        stamp = 1e-6 * float(x.timestamp_sample or x.timestamp)
        self.take(stamp, frames.turn_world(p), R, velocity, frames.turn_body(rates))

    def _take_mode(self, x: Any) -> None:
        self.mode = OFFBOARD if x.flag_control_offboard_enabled else OTHER
        self.armed = bool(x.flag_armed)

    def _take_thrust(self, x: Any) -> None:
        if math.isfinite(x.xyz[2]):
            self.thrusts.append(-float(x.xyz[2]))

    def _take_answer(self, x: Any) -> None:
        topic = bytes(np.asarray(x.topic_name, np.uint8)).split(b"\0")[0].decode("ascii", "replace")
        self._answers[topic] = bool(x.success), int(x.message_hash)
