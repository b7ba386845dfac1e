"""Fields of the messages that are exchanged, by the release in which they took this form.

ROS 2 nodes recognise a type by the hash of its fields (RIHS01), and PX4 by its own hash. Neither covers comments
or constants. The messages of nav_msgs, geometry_msgs and std_msgs come from rosbags.
"""

from collections.abc import Mapping

NEWEST = "newest"

VECTOR = "float32[3]"
CONTROL_FLAGS = (
    "armed", "multicopter_position_control_enabled", "control_manual_enabled", "control_auto_enabled",
    "control_offboard_enabled", "control_position_enabled", "control_velocity_enabled", "control_altitude_enabled",
    "control_climb_rate_enabled", "control_acceleration_enabled", "control_attitude_enabled", "control_rates_enabled",
    "control_allocation_enabled", "control_termination_enabled",
)  # fmt: skip


def _fields(*pairs: str) -> str:
    return "".join(f"{pair}\n" for pair in pairs)


def _with_stamp(*pairs: str) -> str:
    return _fields("uint64 timestamp", *pairs)


def _command(source: str) -> str:
    """Return the fields of VehicleCommand; the type of source_component differs between releases."""
    parameters = (*(f"float32 param{i}" for i in range(1, 5)), "float64 param5", "float64 param6", "float32 param7")
    return _with_stamp(
        *parameters, "uint32 command", "uint8 target_system", "uint8 target_component", "uint8 source_system",
        f"{source} source_component", "uint8 confirmation", "bool from_external",
    )  # fmt: skip


def _flags(*names: str) -> str:
    return _with_stamp(*(f"bool {name}" for name in names))


DEFINITIONS: Mapping[str, Mapping[str, str]] = {
    "px4_msgs/msg/VehicleOdometry": {
        "1.13": _with_stamp(
            "uint64 timestamp_sample", "uint8 local_frame", "float32 x", "float32 y", "float32 z", "float32[4] q",
            "float32[4] q_offset", "float32[21] pose_covariance", "uint8 velocity_frame", "float32 vx", "float32 vy",
            "float32 vz", "float32 rollspeed", "float32 pitchspeed", "float32 yawspeed",
            "float32[21] velocity_covariance", "uint8 reset_counter",
        ),
        "1.14": _with_stamp(
            "uint64 timestamp_sample", "uint8 pose_frame", f"{VECTOR} position", "float32[4] q", "uint8 velocity_frame",
            f"{VECTOR} velocity", f"{VECTOR} angular_velocity", f"{VECTOR} position_variance",
            f"{VECTOR} orientation_variance", f"{VECTOR} velocity_variance", "uint8 reset_counter", "int8 quality",
        ),
    },
    "px4_msgs/msg/VehicleControlMode": {
        "1.14": _flags(*(f"flag_{name}" for name in CONTROL_FLAGS)) + "uint8 source_id\n",
    },
    "px4_msgs/msg/VehicleThrustSetpoint": {"1.14": _with_stamp("uint64 timestamp_sample", f"{VECTOR} xyz")},
    "px4_msgs/msg/VehicleRatesSetpoint": {
        "1.13": _with_stamp("float32 roll", "float32 pitch", "float32 yaw", f"{VECTOR} thrust_body"),
        "1.14": _with_stamp(
            "float32 roll", "float32 pitch", "float32 yaw", f"{VECTOR} thrust_body", "bool reset_integral"
        ),
    },
    "px4_msgs/msg/OffboardControlMode": {
        "1.13": _flags("position", "velocity", "acceleration", "attitude", "body_rate", "actuator"),
        "1.14": _flags(
            "position", "velocity", "acceleration", "attitude", "body_rate", "thrust_and_torque", "direct_actuator"
        ),
    },
    "px4_msgs/msg/TrajectorySetpoint": {
        "1.14": _with_stamp(
            f"{VECTOR} position", f"{VECTOR} velocity", f"{VECTOR} acceleration", f"{VECTOR} jerk", "float32 yaw",
            "float32 yawspeed",
        ),
    },
    "px4_msgs/msg/VehicleCommand": {"1.14": _command("uint8"), "1.15": _command("uint16")},
    "px4_msgs/msg/MessageFormatRequest": {"1.14": _with_stamp("uint16 protocol_version", "char[50] topic_name")},
    "px4_msgs/msg/MessageFormatResponse": {
        "1.14": _with_stamp("uint16 protocol_version", "char[50] topic_name", "bool success", "uint32 message_hash"),
    },
    "mavros_msgs/msg/AttitudeTarget": {
        "1 and 2": _fields(
            "std_msgs/Header header", "uint8 type_mask", "geometry_msgs/Quaternion orientation",
            "geometry_msgs/Vector3 body_rate", "float32 thrust",
        ),
    },
}  # fmt: skip
"""Text of each message by the first release that has it, oldest first."""


def release_of(name: str, release: str) -> str:
    """Return the release in which a message took the form that it has in another release.

    Args:
        name: Name of the message, such as ``px4_msgs/msg/VehicleCommand``.
        release: A release of PX4, such as ``1.16``, or ``newest``.
    """
    known = list(DEFINITIONS[name])
    if release == NEWEST or not all(part.isdigit() for part in release.split(".")):
        return known[-1]
    earlier = [each for each in known if _number(each) <= _number(release)]
    return earlier[-1] if earlier else known[0]


def title_of(name: str, release: str) -> str:
    """Return the description of a release for messages, such as ``px4_msgs 1.15 or later``."""
    package, known = name.partition("/")[0], list(DEFINITIONS.get(name, {}))
    if release not in known:
        return package
    place = known.index(release)
    if release == known[-1]:
        return f"{package} {release} or later" if package == "px4_msgs" else f"{package} {release}"
    return f"{package} {release} (before {known[place + 1]})"


def _number(release: str) -> tuple[int, ...]:
    return tuple(int(part) for part in release.split(".") if part.isdigit())


_PX4 = {release for name, forms in DEFINITIONS.items() if name.startswith("px4_msgs") for release in forms}
RELEASES = (NEWEST, *sorted(_PX4, key=_number))
"""Releases of PX4 in which a message has changed."""
