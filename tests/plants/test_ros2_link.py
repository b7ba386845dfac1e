"""Links to vehicles behind ROS 2: frames, signs, orders of quaternions, and checks before take-off."""

import math
import threading
import time

import numpy as np
import pytest

from fake_ros2 import FakeNetwork, RemoteNode
from retrim import ConfigError, PlantError, Scenario
from retrim.plants.bridges import frames, ros2
from retrim.plants.bridges.ros2_address import Ros2Address, address_of
from retrim.plants.bridges.ros2_link import MavrosLink
from retrim.plants.bridges.ros2_px4_link import TOPICS, Px4Link
from retrim.ros2.message_type import message_type, px4_hash
from retrim.ros2.node import COMMAND, SENSOR

pytest.importorskip("rosbags")
ODOMETRY, POSE, TARGET = "nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped", "mavros_msgs/msg/AttitudeTarget"
ODOM, POSES, ATTITUDE = (
    f"/mavros/{each}" for each in ("local_position/odom", "local_position/pose", "setpoint_raw/attitude")
)
STATE, CONTROL = "/fmu/out/vehicle_odometry", "/fmu/out/vehicle_control_mode"
NORTH = np.array([1.0, 0.0, 0.0, 0.0])  # w, x, y, z: level, nose to the north
HALF = math.sqrt(0.5)
EAST_IN_ROS = (0.0, 0.0, 0.0, 1.0)  # x, y, z, w: level, nose to the east
NORTH_IN_ROS = (0.0, 0.0, HALF, HALF)


@pytest.fixture
def network():
    return FakeNetwork()


@pytest.fixture
def remote(network):
    return RemoteNode(network)


@pytest.fixture
def px4(network):
    return Px4Link(network.node(), address_of("px4"))


@pytest.fixture
def mavros(network):
    return MavrosLink(network.node(), address_of("mavros"))


def stamped(message, t):
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(round(1e9 * t), 10**9)


def odometry(remote, t=1.0, p=(1.0, 2.0, 3.0), q=NORTH_IN_ROS, v=(0.4, 0.0, 0.0), rates=(0.1, 0.2, 0.3), child="base"):
    def fill(m):
        stamped(m, t)
        m.header.frame_id, m.child_frame_id = "map", child
        for place, values in ((m.pose.pose.position, p), (m.twist.twist.linear, v), (m.twist.twist.angular, rates)):
            place.x, place.y, place.z = values
        o = m.pose.pose.orientation
        o.x, o.y, o.z, o.w = q

    remote.publish(ODOM, ODOMETRY, fill)


def vehicle(remote, t=1.0, p=(1.0, 2.0, -3.0), q=NORTH, v=(0.4, 0.5, 0.6), rates=(0.1, 0.2, 0.3), frame=1, of_v=1):
    remote.publish(
        STATE, "px4_msgs/msg/VehicleOdometry", timestamp_sample=round(1e6 * t), pose_frame=frame, velocity_frame=of_v,
        position=np.array(p, np.float32), q=np.array(q, np.float32), velocity=np.array(v, np.float32),
        angular_velocity=np.array(rates, np.float32),
    )  # fmt: skip


# ---- states


def test_px4_state_is_converted_to_retrim_frames(remote, px4):
    vehicle(remote)
    x = px4.reading
    np.testing.assert_allclose(x.p, [2.0, 1.0, 3.0])  # east, north, up
    np.testing.assert_allclose(x.v, [0.5, 0.4, -0.6], rtol=1e-6)
    np.testing.assert_allclose(x.omega, [0.1, -0.2, -0.3], rtol=1e-6)
    assert frames.heading_of(x.R) == pytest.approx(math.pi / 2)  # counter-clockwise from east


def test_px4_quaternions_begin_with_w(remote, px4):
    vehicle(remote, q=(HALF, 0.0, 0.0, HALF))  # a quarter turn to the right, from north to east
    np.testing.assert_allclose(px4.reading.R, np.eye(3), atol=1e-6)
    vehicle(remote, t=2.0, q=(math.cos(0.1), math.sin(0.1), 0.0, 0.0))  # right side down, nose to the north
    up = px4.reading.R[:, 2]
    np.testing.assert_allclose(up, [math.sin(0.2), 0.0, math.cos(0.2)], atol=1e-6)  # the thrust points to the east


def test_px4_velocity_may_be_in_body_frame(remote, px4):
    vehicle(remote, q=(HALF, 0.0, 0.0, HALF), v=(1.0, 2.0, 3.0), of_v=3)  # nose to the east: forward, right, down
    np.testing.assert_allclose(px4.reading.v, [1.0, -2.0, -3.0], atol=1e-6)


@pytest.mark.parametrize(("bad", "why"), [
    ({"frame": 0}, "in frame 0"), ({"of_v": 0}, "velocities in frame 0"), ({"p": (math.nan, 0, 0)}, "not finite"),
    ({"q": (0, 0, 0, 0)}, "without an attitude"), ({"rates": (0, math.inf, 0)}, "not finite"),
])  # fmt: skip
def test_implausible_px4_states_are_ignored(remote, px4, bad, why):
    vehicle(remote, **bad)
    assert (px4.reading, px4.ignored) == (None, 1)
    assert why in px4.notes[0]


def test_mavros_has_retrim_frames_and_quaternions_end_with_w(remote, mavros):
    odometry(remote)
    x = mavros.reading
    np.testing.assert_allclose(x.p, [1.0, 2.0, 3.0])
    np.testing.assert_allclose(x.R[:, 0], [0.0, 1.0, 0.0], atol=1e-9)  # the nose points to the north
    np.testing.assert_allclose(x.v, [0.0, 0.4, 0.0], atol=1e-9)  # forward, in the child frame
    np.testing.assert_allclose(x.omega, [0.1, 0.2, 0.3])


@pytest.mark.parametrize("child", ["map", ""])
def test_twist_in_world_frame_is_recognised(remote, mavros, child):
    odometry(remote, child=child)
    np.testing.assert_allclose(mavros.reading.v, [0.4, 0.0, 0.0])
    np.testing.assert_allclose(mavros.reading.omega, [0.2, -0.1, 0.3], atol=1e-9)


def test_px4_and_mavros_give_same_state(remote, network):
    """One state, from PX4 and from mavros."""
    px4, mavros = Px4Link(network.node(), address_of("px4")), MavrosLink(network.node(), address_of("mavros"))
    rng = np.random.default_rng(3)
    q = rng.normal(size=4)
    q /= np.linalg.norm(q)
    p, v, rates = rng.normal(size=(3, 3))
    R = frames.attitude_of(q)  # q of PX4
    from scipy.spatial.transform import Rotation

    vehicle(remote, p=p, q=q, v=v, rates=rates)
    odometry(
        remote, p=frames.turn_world(p), q=Rotation.from_matrix(R).as_quat(), rates=frames.turn_body(rates),
        v=R.T @ frames.turn_world(v),
    )  # fmt: skip
    for mine, other in zip(px4.reading[1:], mavros.reading[1:], strict=True):
        np.testing.assert_allclose(mine, other, atol=1e-5)


def test_velocities_follow_from_poses_without_odometry(remote, mavros):
    def pose(k):
        def fill(m):
            stamped(m, 100.0 + 0.01 * k)
            m.pose.position.x = 0.02 * k  # 2 m/s
            m.pose.orientation.z, m.pose.orientation.w = math.sin(0.005 * k), math.cos(0.005 * k)  # 1 rad/s

        return fill

    for k in range(40):
        remote.publish(POSES, POSE, pose(k))
        time.sleep(0.01)
    np.testing.assert_allclose(mavros.reading.v, [2.0, 0.0, 0.0], atol=0.4)  # the first times are those of arrival
    np.testing.assert_allclose(mavros.reading.omega, [0.0, 0.0, 1.0], atol=0.3)
    odometry(remote, t=200.0)
    remote.publish(POSES, POSE, pose(60))
    np.testing.assert_allclose(mavros.reading.p, [1.0, 2.0, 3.0])  # odometry is recent


def test_reordered_and_duplicate_states_are_ignored(remote, px4):
    for t, p in ((1.00, 0.0), (1.02, 2.0), (1.01, 1.0), (1.02, 9.0), (1.04, 4.0), (1.03, 3.0)):
        vehicle(remote, t=t, p=(0.0, p, 0.0))
        assert px4.reading.p[0] in (0.0, 2.0, 4.0)
    assert px4.reading.p[0] == 4.0


@pytest.mark.parametrize("jump", [-3600.0, -0.2, 0.7, 3600.0])
def test_adjusted_clock_is_followed_within_three_states(remote, px4, jump):
    for k in range(20):
        vehicle(remote, t=5000.0 + 0.01 * k)
        time.sleep(0.01)
    for k in range(20, 26):
        vehicle(remote, t=5000.0 + 0.01 * k + jump, p=(0.0, k, 0.0))
        time.sleep(0.01)
    now = time.monotonic()
    assert px4.reading.p[0] == 25.0
    assert 0.0 <= now - px4.reading.stamp < 0.1
    assert now - px4.last_message < 0.1


def test_state_without_stamp_has_arrival_time(remote, mavros):
    for _ in range(3):
        odometry(remote, t=0.0)
        assert 0.0 <= time.monotonic() - mavros.reading.stamp < 0.05


# ---- setpoints


def test_setpoints_are_converted_to_px4_frames(remote, px4):
    rates, wish, place = (
        "/fmu/in/vehicle_rates_setpoint",
        "/fmu/in/offboard_control_mode",
        "/fmu/in/trajectory_setpoint",
    )
    for topic in (rates, wish, place):
        remote.subscribe(topic, f"px4_msgs/msg/{TOPICS[topic.rpartition('/')[2]]}")
    px4.fly_rates(0.3, np.array([0.1, 0.2, 0.4]))
    (m,), (mode,) = remote.messages[rates], remote.messages[wish]
    np.testing.assert_allclose([m.roll, m.pitch, m.yaw], [0.1, -0.2, -0.4], rtol=1e-6)
    np.testing.assert_allclose(m.thrust_body, [0.0, 0.0, -0.3], rtol=1e-6)  # upwards
    assert (mode.position, mode.body_rate, mode.attitude, mode.direct_actuator) == (False, True, False, False)
    assert abs(1e-6 * m.timestamp - time.time()) < 5.0
    px4.fly_to(np.array([1.0, 2.0, 3.0]), math.pi / 2)
    (m,), mode = remote.messages[place], remote.messages[wish][-1]
    np.testing.assert_allclose(m.position, [2.0, 1.0, -3.0])
    assert m.yaw == pytest.approx(0.0, abs=1e-6)  # north
    assert all(np.isnan(each).all() for each in (m.velocity, m.acceleration, m.jerk, m.yawspeed))
    assert (mode.position, mode.body_rate) == (True, False)


def test_vehicle_command_addresses_any_system(remote, px4):
    remote.subscribe("/fmu/in/vehicle_command", "px4_msgs/msg/VehicleCommand")
    px4.command(176, 1.0, 6.0)
    (m,) = remote.messages["/fmu/in/vehicle_command"]
    assert (m.command, m.param1, m.param2, m.param3, m.from_external) == (176, 1.0, 6.0, 0.0, True)
    assert (m.target_system, m.target_component) == (0, 0)


def test_mavros_target_has_rates_in_retrim_frame(remote, mavros):
    remote.subscribe(ATTITUDE, TARGET)
    mavros.fly_rates(0.3, np.array([0.1, 0.2, 0.4]))
    (m,) = remote.messages[ATTITUDE]
    assert (m.body_rate.x, m.body_rate.y, m.body_rate.z) == (0.1, 0.2, 0.4)
    assert m.thrust == pytest.approx(0.3)
    assert m.type_mask == 128  # ignore the attitude
    assert abs(m.header.stamp.sec - time.time()) < 5.0


def test_mode_is_read(remote, px4):
    for armed, offboard in ((False, False), (True, False), (True, True)):
        remote.publish(
            CONTROL, "px4_msgs/msg/VehicleControlMode", flag_armed=armed, flag_control_offboard_enabled=offboard
        )
        assert (px4.armed, px4.mode[0] == 6) == (armed, offboard)


def test_quality_of_service_equals_px4(px4, mavros):
    assert {px4.node.qos[topic] for topic in px4.node.qos} == {SENSOR}  # best effort, volatile
    assert mavros.node.qos[ODOM] == SENSOR
    assert mavros.node.qos[ATTITUDE] == COMMAND  # reliable, which every subscriber accepts


# ---- versions


def answer_format_requests(remote, release="newest", known=True):
    """Answer requests for the formats of PX4's inputs."""

    def answer(m):
        topic = bytes(m.topic_name).split(b"\0")[0].decode()
        value = px4_hash(f"px4_msgs/msg/{TOPICS[topic.rpartition('/')[2]]}", release)
        remote.publish(
            "/fmu/out/message_format_response", "px4_msgs/msg/MessageFormatResponse", protocol_version=1,
            topic_name=m.topic_name, success=known, message_hash=value,
        )  # fmt: skip

    remote.subscribe("/fmu/in/message_format_request", "px4_msgs/msg/MessageFormatRequest", answer)


def test_formats_of_firmware_are_requested(remote, px4):
    answer_format_requests(remote)
    assert px4.format_fault() == ""
    assert len(remote.messages["/fmu/in/message_format_request"]) == len(TOPICS)
    assert px4.notes == []


def test_firmware_of_other_release_is_refused(remote, px4, network):
    answer_format_requests(remote, "1.14")
    fault = px4.format_fault()
    assert "/fmu/in/vehicle_command: px4_msgs/msg/VehicleCommand is that of px4_msgs 1.14 (before 1.15)" in fault
    assert "in the firmware, and of px4_msgs 1.15 or later here" in fault
    assert Px4Link(network.node(), address_of("px4-1.14")).format_fault() == ""


def test_missing_input_of_firmware_is_refused(remote, px4):
    answer_format_requests(remote, known=False)
    assert px4.format_fault().startswith("PX4 has no input /fmu/in/vehicle_rates_setpoint")


def test_firmware_without_answer_is_noted(px4, monkeypatch):
    monkeypatch.setattr("retrim.plants.bridges.ros2_px4_link.ANSWER_S", 0.1)
    assert px4.format_fault() == ""
    assert "PX4 does not tell the formats of its inputs" in px4.notes[0]


@pytest.fixture
def connects(monkeypatch, network):
    """Let the plant use a node of the fake network, with short time-outs."""
    monkeypatch.setattr(ros2, "open_node", lambda *_: network.node())
    monkeypatch.setattr(ros2, "WAIT_S", 0.4)
    monkeypatch.setattr(ros2, "LISTENER_S", 0.4)
    monkeypatch.setattr(ros2, "CROWD_S", 0.4)
    monkeypatch.setattr("retrim.plants.bridges.ros2_px4_link.ANSWER_S", 0.1)

    def connect(address):
        plant = Scenario(plant=f"ros2:{address}").make("small")
        try:
            plant.connect()
            return plant
        finally:
            plant.stop()

    return connect


@pytest.fixture
def periodic(remote):
    """Return a context that repeats a call at 100 Hz or less."""
    over = threading.Event()

    def begin(say, rate=100.0):
        def go():
            k = 0
            while not over.wait(1.0 / rate):
                k += 1
                say(remote, t=1000.0 + k / rate)

        threading.Thread(target=go, daemon=True).start()

    yield begin
    over.set()
    time.sleep(0.05)


def subscribe_to_setpoints(remote, release="newest"):
    for topic, name in TOPICS.items():
        remote.subscribe(f"/fmu/in/{topic}", f"px4_msgs/msg/{name}", release=release)


def test_available_vehicle_is_connected(connects, periodic, remote):
    subscribe_to_setpoints(remote)
    answer_format_requests(remote)
    periodic(vehicle)
    assert connects("px4").notes == ()


def test_missing_vehicle_is_reported(connects):
    with pytest.raises(
        PlantError, match=r"no state arrived on /mavros/local_position/odom or /mavros/.*pose in 0\.4 s"
    ):
        connects("mavros")


@pytest.mark.parametrize(
    ("topics", "advice"),
    [
        ({}, "no other node was found: check the network"),
        ({"/scan": "std_msgs/msg/String"}, "other nodes publish no odometry and no poses, but /scan"),
        (
            {"/mocap/quad": "geometry_msgs/msg/PoseStamped", "/vio": "nav_msgs/msg/Odometry"},
            "other nodes publish states, for odometry=/vio or pose=/mocap/quad",
        ),
        (
            {"/px4_1/fmu/out/vehicle_odometry": "px4_msgs/msg/VehicleOdometry"},
            "other nodes publish states, for px4/px4_1",
        ),
    ],
)
def test_missing_state_names_available_ones(connects, remote, topics, advice):
    for topic, name in topics.items():
        remote.publish(topic, name)
    with pytest.raises(PlantError, match=f"no state arrived on /fmu/out/vehicle_odometry in .*; {advice}"):
        connects("px4")


def test_states_of_other_release_are_refused(connects, periodic):
    def old(remote, t):
        remote.publish(STATE, "px4_msgs/msg/VehicleOdometry", release="1.13")

    periodic(old)
    with pytest.raises(PlantError, match=r"px4_msgs 1\.13 \(before 1\.14\); this end has px4_msgs 1\.14 or"):
        connects("px4")


def test_subscriber_of_other_release_is_refused(connects, periodic, remote):
    subscribe_to_setpoints(remote, "1.14")
    periodic(vehicle)
    with pytest.raises(PlantError, match=r"VehicleCommand is that of px4_msgs 1\.14 .* use the same px4_msgs"):
        connects("px4")


def test_connection_to_firmware_of_other_release_is_refused(connects, periodic, remote):
    subscribe_to_setpoints(remote)
    answer_format_requests(remote, "1.14")
    periodic(vehicle)
    with pytest.raises(PlantError, match=r"in the firmware, .* name the firmware's release, as in ros2:px4-1\.14"):
        connects("px4")


def test_setpoints_without_subscriber_are_refused(connects, periodic):
    periodic(vehicle)
    with pytest.raises(PlantError, match="no node subscribes to /fmu/in/vehicle_rates_setpoint, /fmu/in/offboard"):
        connects("px4")


def test_rare_states_are_refused(connects, periodic, remote):
    subscribe_to_setpoints(remote)
    periodic(vehicle, rate=5.0)
    with pytest.raises(PlantError, match=r"states come at \d Hz; at least 15 Hz are needed on /fmu/out"):
        connects("px4")


def test_two_publishers_of_state_are_refused(connects, periodic, remote, network):
    subscribe_to_setpoints(remote)
    periodic(vehicle)
    network.node().advertise(STATE, message_type("px4_msgs/msg/VehicleOdometry"), SENSOR)
    with pytest.raises(PlantError, match="several nodes publish /fmu/out/vehicle_odometry"):
        connects("px4")


# ---- addresses


@pytest.mark.parametrize(("text", "address"), [
    ("", Ros2Address("", "", "px4", "newest", "")),
    ("px4", Ros2Address("", "", "px4", "newest", "")),
    ("cyclonedds", Ros2Address("cyclonedds", "", "px4", "newest", "")),
    ("px4-1.14/px4_1", Ros2Address("", "", "px4", "1.14", "/px4_1")),
    ("mavros", Ros2Address("", "", "mavros", "newest", "/mavros")),
    ("rclpy:mavros/quad1/mavros", Ros2Address("rclpy", "", "mavros", "newest", "/quad1/mavros")),
    ("zenoh@10.0.0.7:7447:px4", Ros2Address("zenoh", "10.0.0.7:7447", "px4", "newest", "")),
    ("mavros,pose=/mocap/quad1", Ros2Address("", "", "mavros", "newest", "/mavros", pose="/mocap/quad1")),
    ("px4,odometry=/vio/odom", Ros2Address("", "", "px4", "newest", "", odometry="/vio/odom")),
])  # fmt: skip
def test_addresses(text, address):
    assert address_of(text) == address
    assert Scenario(plant=f"ros2:{text}" if text else "ros2").entry.is_vehicle


@pytest.mark.parametrize("text", [
    "px5", "mavros-1.14", "px4-1.13", "px4-9", "rclpy@10.0.0.7:7447:px4", "mavros/", "px4,imu=/x", "px4,pose=x",
    "/a//b", "px4-1.14,odometry=/a b", "dds:px4", "ros2:px4",
])  # fmt: skip
def test_wrong_address_is_refused_before_flight(text):
    with pytest.raises(ConfigError, match=r"address '.*': (expected ros2:|a release follows px4)|absolute name"):
        Scenario(plant=f"ros2:{text}")


# ---- thrust


@pytest.mark.parametrize("reports", [False, True])
def test_thrust_scale_is_from_autopilot_or_vehicle_file(network, remote, reports):
    vehicle = Scenario(plant="simple").make_vehicle("small")
    strongest = float(vehicle.thrust_max / vehicle.mass)
    plant = Scenario(plant="ros2:px4").make("small")
    plant._link = link = Px4Link(network.node(), address_of("px4"))
    for _ in range(10 * reports):
        remote.publish(
            "/fmu/out/vehicle_thrust_setpoint", "px4_msgs/msg/VehicleThrustSetpoint",
            xyz=np.array([0.0, 0.0, -0.4], np.float32),
        )  # fmt: skip
    plant._learn_thrust()
    assert plant.thrust.hover == pytest.approx(0.4 if reports else 9.81 / strongest, rel=1e-3)
    remote.subscribe("/fmu/in/vehicle_rates_setpoint", "px4_msgs/msg/VehicleRatesSetpoint")
    accepted = plant.send(np.array([9.81, 0.0, 0.0, 0.0]))
    assert accepted[0] == pytest.approx(9.81)
    assert remote.messages["/fmu/in/vehicle_rates_setpoint"][0].thrust_body[2] == pytest.approx(-plant.thrust.hover)
    link.close()
