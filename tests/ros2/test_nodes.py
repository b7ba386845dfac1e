"""Nodes of ROS 2: two nodes of each back end exchange messages on this machine. `make test-ros2` also uses rclpy."""

import struct
import time

import pytest

from retrim import ConfigError
from retrim.ros2 import backends
from retrim.ros2.backends import choose_backend, open_node
from retrim.ros2.cyclonedds_node import configuration
from retrim.ros2.message_type import message_type
from retrim.ros2.node import COMMAND, SENSOR, mismatches
from retrim.ros2.zenoh_node import ZenohNode
from retrim_paper.latency import free_port

pytest.importorskip("rosbags")
NETWORKS = ("cyclonedds", "zenoh")
ODOMETRY, POSE = "nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped"
TARGET = "mavros_msgs/msg/AttitudeTarget"


@pytest.fixture(autouse=True)
def limit_discovery(monkeypatch):
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    monkeypatch.setenv("ROS_DOMAIN_ID", "77")


@pytest.fixture(params=NETWORKS)
def nodes(request):
    pytest.importorskip(request.param)
    if request.param == "zenoh":
        address = f"127.0.0.1:{free_port()}"
        pair = ZenohNode(address, listen=True), ZenohNode(address)
    else:
        pair = open_node(request.param, ()), open_node(request.param, ())
    yield pair
    for node in pair:
        node.close()
        node.close()  # a second call has no effect


def until(condition, again=lambda: None, patience=15.0):
    end = time.monotonic() + patience
    while not condition():
        assert time.monotonic() < end
        again()
        time.sleep(0.02)


@pytest.mark.parametrize(
    "name", [ODOMETRY, POSE, TARGET, "px4_msgs/msg/VehicleOdometry", "std_msgs/msg/UInt8MultiArray"]
)
@pytest.mark.parametrize("qos", [SENSOR, COMMAND], ids=["sensor", "command"])
def test_messages_arrive_unchanged(nodes, name, qos):
    here, there = nodes
    kind, messages = message_type(name), []
    message = kind.new()
    if name == TARGET:
        message.thrust, message.header.frame_id = 0.25, "map"
    publish = here.advertise("/quad1/topic", kind, qos)
    there.subscribe("/quad1/topic", kind, SENSOR, messages.append)
    until(lambda: messages, lambda: publish(kind.encode(message)))
    assert kind.encode(kind.decode(messages[0])) == kind.encode(message)


def test_other_ends_are_found_with_type_and_hash(nodes):
    here, there = nodes
    kind, other = message_type("px4_msgs/msg/VehicleCommand"), message_type("px4_msgs/msg/VehicleCommand", "1.14")
    here.advertise("/fmu/in/vehicle_command", other, SENSOR)
    there.subscribe("/fmu/in/vehicle_command", kind, SENSOR, lambda data: None)
    until(lambda: there.endpoints("/fmu/in/vehicle_command"))
    (end,) = there.endpoints("/fmu/in/vehicle_command")
    assert end == (other.name, other.hash, True)
    (fault,) = mismatches("/x", kind, [end])
    assert "px4_msgs 1.14 (before 1.15) at the other end, and of px4_msgs 1.15 or later here" in fault
    assert there.endpoints("/elsewhere") == []
    assert there.published_topics()["/fmu/in/vehicle_command"] == "px4_msgs/msg/VehicleCommand"
    assert "/fmu/in/vehicle_command" not in here.published_topics()


def test_keys_and_attachments_equal_rmw_zenoh():
    zenoh = pytest.importorskip("zenoh")
    address = f"127.0.0.1:{free_port()}"
    node, other = ZenohNode(address, listen=True), ZenohNode(address)
    kind, samples = message_type(POSE), []
    try:
        other._session.declare_subscriber("77/pose/**", samples.append)
        publish = node.advertise("/pose", kind, SENSOR)
        until(lambda: len(samples) > 1, lambda: publish(kind.encode(kind.new())))
        (token,) = (
            str(reply.ok.key_expr) for reply in other._session.liveliness().get("@ros2_lv/77/*/*/*/MP/**", timeout=1.0)
        )
    finally:
        other.close()
        node.close()
    assert str(samples[0].key_expr) == f"77/pose/geometry_msgs::msg::dds_::PoseStamped_/{kind.hash}"
    assert isinstance(samples[0].attachment, zenoh.ZBytes)
    attachment = [bytes(sample.attachment) for sample in samples[:2]]
    numbers, times = zip(*(struct.unpack_from("<qq", each) for each in attachment), strict=True)
    assert numbers[1] == numbers[0] + 1
    assert times[0] < times[1] < time.time_ns()
    assert [len(each) for each in attachment] == [33, 33]
    assert attachment[0][16] == 16  # bytes of the publisher's identifier, which is constant
    assert attachment[0][17:] == attachment[1][17:]
    assert token.split("/")[6:12] == ["%", "%", "retrim", "%pose", kind.dds_name, kind.hash]


def test_installed_ros_has_priority(monkeypatch):
    installed = {"rclpy", "px4_msgs", "cyclonedds", "zenoh"}
    monkeypatch.setattr(backends, "is_installed", lambda name: name in installed)
    assert choose_backend(("px4_msgs",)) == "rclpy"
    assert choose_backend(("mavros_msgs",)) == "cyclonedds"  # this back end needs no package of messages
    installed.remove("cyclonedds")
    assert choose_backend(("mavros_msgs",)) == "zenoh"
    installed.clear()
    with pytest.raises(ConfigError, match=r"ROS 2 needs rclpy .* or cyclonedds, or zenoh.*pip install cyclonedds"):
        choose_backend(())


def test_ros_variables_configure_cyclone(monkeypatch):
    assert 'address="127.0.0.1"' in configuration()
    assert 'name="lo"' in configuration()
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "SUBNET")
    monkeypatch.setenv("ROS_STATIC_PEERS", "127.0.0.1")
    assert '<NetworkInterface address="127.0.0.1"/>' in configuration()  # the interface of the route to the peer
    monkeypatch.setenv("ROS_STATIC_PEERS", "10.0.0.7;quad1.local")
    assert 'name="lo"' not in configuration()
    assert '<Peer address="10.0.0.7"/><Peer address="quad1.local"/>' in configuration()
    monkeypatch.setenv("ROS_STATIC_PEERS", "é..")  # no interface leads to a name that cannot be looked up
    assert '<Peer address="é.."/>' in configuration()
    monkeypatch.setenv("ROS_STATIC_PEERS", '"/><x')
    with pytest.raises(ConfigError, match="is not an address of a machine"):
        configuration()
