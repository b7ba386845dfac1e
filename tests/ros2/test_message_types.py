"""Message types of ROS 2: hashes of ROS and of PX4, lengths, and refusals."""

import numpy as np
import pytest

from retrim import ConfigError
from retrim.errors import MessageError
from retrim.ros2.definitions import DEFINITIONS, release_of
from retrim.ros2.message_type import (
    message_type,
    px4_hash,
    title_by_hash,
    title_by_px4_hash,
)
from retrim.ros2.node import Endpoint, check_topic, domain_id, mismatches, ros_name

pytest.importorskip("rosbags")

RCLPY = {
    "nav_msgs/msg/Odometry": "RIHS01_3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0",
    "geometry_msgs/msg/PoseStamped": "RIHS01_10f3786d7d40fd2b54367835614bff85d4ad3b5dab62bf8bca0cc232d73b4cd8",
}
"""Hashes that rclpy 9.1.2 (Kilted) reports for its publishers."""
FIRMWARE = {
    "VehicleRatesSetpoint": 0x79992167, "OffboardControlMode": 0x2FF32960, "VehicleCommand": 0xCBA514AF,
    "VehicleOdometry": 0x3AF07476, "TrajectorySetpoint": 0xF614ACDE, "VehicleControlMode": 0x25A90612,
    "VehicleThrustSetpoint": 0x67088E65, "MessageFormatRequest": 0x24E20CB7, "MessageFormatResponse": 0x60A08C2D,
}  # fmt: skip
"""Hashes in the program of PX4 (main branch of March 2026)."""
COMMAND = "px4_msgs/msg/VehicleCommand"
KINDS = [(name, release) for name, forms in DEFINITIONS.items() for release in forms]


@pytest.mark.parametrize("name", RCLPY)
def test_hashes_equal_rclpy(name):
    assert message_type(name).hash == RCLPY[name]


@pytest.mark.parametrize("name", FIRMWARE)
def test_hashes_equal_firmware(name):
    assert px4_hash(f"px4_msgs/msg/{name}") == FIRMWARE[name]


@pytest.mark.parametrize(("name", "release"), KINDS)
def test_message_survives_round_trip(name, release):
    kind, rng = message_type(name, release), np.random.default_rng(0)
    message = kind.new()
    for field, value in vars(message).items() if hasattr(message, "__dict__") else []:
        if isinstance(value, np.ndarray):
            setattr(message, field, rng.integers(0, 100, value.shape).astype(value.dtype))
        elif isinstance(value, float):
            setattr(message, field, float(np.float32(rng.normal())))
        elif isinstance(value, int) and not isinstance(value, bool):
            setattr(message, field, int(rng.integers(0, 100)))
    data = kind.encode(message)
    assert data[:4] == b"\0\1\0\0"  # little endian
    for padding in range(4):
        assert kind.encode(kind.decode(data + bytes(padding))) == data
    assert kind.size in (None, len(data))


@pytest.mark.parametrize(("name", "release"), KINDS)
def test_releases_have_distinct_hashes(name, release):
    for other in DEFINITIONS[name]:
        same = other == release
        assert (message_type(name, other).hash == message_type(name, release).hash) == same
        assert (px4_hash(name, other) == px4_hash(name, release)) == same


def test_release_is_recognised_from_other_end():
    assert [release_of(COMMAND, each) for each in ("1.13", "1.14", "1.15", "1.16", "2.0", "newest")] == [
        "1.14", "1.14", "1.15", "1.15", "1.15", "1.15",
    ]  # fmt: skip
    assert title_by_hash(COMMAND, message_type(COMMAND, "1.14").hash) == "px4_msgs 1.14 (before 1.15)"
    assert title_by_hash(COMMAND, "RIHS01_" + 64 * "0") == "an unknown version (RIHS01_00000000...)"
    assert title_by_px4_hash(COMMAND, px4_hash(COMMAND, "1.15")) == "px4_msgs 1.15 or later"
    assert title_by_px4_hash(COMMAND, 5) == "an unknown version (hash 0x00000005)"


def test_message_of_other_release_is_refused_with_both_names():
    old, new = (message_type("px4_msgs/msg/VehicleOdometry", release) for release in ("1.13", "1.14"))
    why = (
        r"VehicleOdometry of 265 bytes, which is the length in px4_msgs 1\.13 \(before 1\.14\); "
        r"this end has px4_msgs 1\.14 or later, 118 bytes"
    )
    with pytest.raises(MessageError, match=why):
        new.decode(old.encode(old.new()))
    with pytest.raises(MessageError, match="which is the length in an unknown version"):
        new.decode(bytes(50))


@pytest.mark.parametrize("data", [b"", b"\0", b"\0\1\0\0", b"\xff" * 76, bytes(700), b"\0\1\0\0" + b"\xff" * 72])
@pytest.mark.parametrize(
    "name", ["nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped", "mavros_msgs/msg/AttitudeTarget"]
)
def test_invalid_bytes_are_refused(name, data):
    with pytest.raises(MessageError, match=rf"{name}: \d+ bytes that cannot be read"):
        message_type(name).decode(data)


def test_types_of_other_ends_are_compared():
    kind = message_type(COMMAND)
    old = message_type(COMMAND, "1.14")
    assert mismatches("/x", kind, [Endpoint(COMMAND, each, True) for each in (kind.hash, "")]) == []
    assert mismatches("/x", kind, [Endpoint(COMMAND, old.hash, True)] * 2) == [
        "/x: px4_msgs/msg/VehicleCommand is that of px4_msgs 1.14 (before 1.15) at the other end, and of px4_msgs 1.15 "
        "or later here"
    ]
    assert mismatches("/x", kind, [Endpoint("std_msgs/msg/String", "", False)]) == [
        "/x is std_msgs/msg/String at the other end, and px4_msgs/msg/VehicleCommand here"
    ]


def test_names_of_dds_and_ros():
    kind = message_type(COMMAND)
    assert kind.dds_name == "px4_msgs::msg::dds_::VehicleCommand_"
    assert ros_name(kind.dds_name) == COMMAND
    assert ros_name("Something::Else") == "Something::Else"
    check_topic("/fmu/in/vehicle_command")
    for topic in ("fmu/in", "", "/", "/a//b", "/a b", "/1a", "/ä"):
        with pytest.raises(ConfigError, match="expected an absolute name"):
            check_topic(topic)


@pytest.mark.parametrize(("text", "domain"), [("", 0), ("7", 7), ("232", 232)])
def test_domain_is_that_of_environment_variable(monkeypatch, text, domain):
    monkeypatch.setenv("ROS_DOMAIN_ID", text)
    assert domain_id() == domain


@pytest.mark.parametrize("text", ["-1", "233", "one", "٣"])
def test_wrong_domain_is_refused(monkeypatch, text):
    monkeypatch.setenv("ROS_DOMAIN_ID", text)
    with pytest.raises(ConfigError, match="expected a number from 0 to 232"):
        domain_id()
