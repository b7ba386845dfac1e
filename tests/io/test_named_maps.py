"""The same flight in the formats of autopilots and their tools: without a map, its fields identify the format."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fake_bytes import PX4_ODOMETRY, PX4_OLD_ODOMETRY, bag2, px4_messages, px4_topics, ulog
from fake_log import G, fly_once, write_csv
from retrim.errors import LogError
from retrim.io.logs import read_flight_log, read_map
from retrim.io.logs.log_map import Time
from retrim.io.logs.message_times import evenly
from retrim.io.logs.named_maps import USUAL_NAMES, names
from retrim.replay import rows_of

FLIGHT = fly_once(8.0)
Q = Rotation.from_matrix(FLIGHT.R).as_quat()


def assert_is_flight(log, places=1e-4, command=True):
    """Assert that the residual is zero, and that the states are those of the flight."""
    start = round(float(np.argmin(np.linalg.norm(FLIGHT.p - log.p[10], axis=1)))) - 10
    part = slice(start, start + len(log.t))
    np.testing.assert_allclose(log.p[:200], FLIGHT.p[part][:200], atol=places)
    np.testing.assert_allclose(log.v[:200], FLIGHT.v[part][:200], atol=10 * places)
    np.testing.assert_allclose(log.R[:200], FLIGHT.R[part][:200], atol=10 * places)
    if command:
        np.testing.assert_allclose(log.command[:200], FLIGHT.omega[part][:200], atol=0.02)
    assert np.abs(np.asarray(rows_of(log).a_res)[log.valid]).max() < 0.1
    assert log.full_thrust == pytest.approx(2.0 * G[2], rel=1e-2)
    assert log.valid.mean() > 0.95


def test_every_name_is_a_map():
    assert {name for usual in USUAL_NAMES.values() for name in usual} <= set(names())
    for name in names():
        read_map(name)


@pytest.mark.parametrize("jitter", [0.0, 0.006])
@pytest.mark.parametrize("old", [False, True])
def test_px4_over_dds(old, jitter, tmp_path):
    """The log has either layout of the odometry, and times are those in the messages, regardless of their reception."""
    pytest.importorskip("rosbags")
    folder = "/fmu/{}/" if not old else "/fmu/"
    messages = px4_messages(FLIGHT, old=old, jitter=jitter, folder=folder)
    log = read_flight_log(bag2(tmp_path / "fmu", PX4_OLD_ODOMETRY if old else PX4_ODOMETRY, messages))
    assert_is_flight(log, 2e-3 if jitter and old else 1e-4)


def test_command_clock_is_converted_to_recorder_clock(tmp_path):
    """An offboard computer uses the time of day, and the autopilot the time since its start."""
    pytest.importorskip("rosbags")
    messages = px4_messages(FLIGHT, clock=lambda t: round(1.7e15 + 1e6 * t))
    log = read_flight_log(bag2(tmp_path / "fmu", PX4_ODOMETRY, messages))
    assert_is_flight(log, 1e-3)
    assert any("clocks of their own" in note for note in log.notes)


def test_commands_without_stamp_use_time_of_reception(tmp_path):
    pytest.importorskip("rosbags")
    log = read_flight_log(bag2(tmp_path / "fmu", PX4_ODOMETRY, px4_messages(FLIGHT, clock=lambda t: 0)))
    assert_is_flight(log, 1e-3)
    assert any("no stamps; its times are those of reception" in note for note in log.notes)


def test_namespace_and_version_in_topic_names(tmp_path):
    pytest.importorskip("rosbags")
    messages = [
        (topic + "_v1" * ("odometry" in topic), *rest) for topic, *rest in px4_messages(FLIGHT, folder="/uav3/fmu/{}/")
    ]
    assert_is_flight(read_flight_log(bag2(tmp_path / "fmu", PX4_ODOMETRY, messages)))
    two = messages + [("/uav4" + topic[5:], *rest) for topic, *rest in messages]
    with pytest.raises(
        LogError, match=r"matches several topics: /uav3/fmu/out/vehicle_odometry_v1, /uav4/.*; name one"
    ):
        read_flight_log(bag2(tmp_path / "two", PX4_ODOMETRY, two))


def test_map_states_time_field_of_messages(tmp_path):
    """A custom message has no header, and a time in milliseconds."""
    pytest.importorskip("rosbags")
    kind, rng = "mine_msgs/msg/State", np.random.default_rng(0)
    definition = {kind: "float64 at\nfloat64[3] p\nfloat64[3] v\nfloat64[4] q\nfloat64[3] w\nfloat64 c\n"}

    def messages():
        for k, t in enumerate(FLIGHT.t):
            arrival = int(1.7e18 + 1e9 * t + 3e6 * abs(rng.normal())) + k
            yield "/state", kind, arrival, {
                "at": 1000.0 * (t + 5.0), "p": FLIGHT.p[k], "v": FLIGHT.v[k], "q": Q[k], "w": FLIGHT.omega[k],
                "c": 0.5 * FLIGHT.c[k] / G[2]}  # fmt: skip

    path = bag2(tmp_path / "mine", definition, messages())
    (tmp_path / "map.toml").write_text("""
    time = { field = "at", unit = "ms" }
    position.fields = ["/state.p"]
    velocity.fields = ["/state.v"]
    attitude = { fields = ["/state.q"], form = "xyzw" }
    thrust = { fields = ["/state.c"], unit = "share" }
    rates.fields = ["/state.w"]
    """)
    log = read_flight_log(path, read_map(tmp_path / "map.toml"))
    assert_is_flight(log, 1e-6)
    assert not any("reception" in note for note in log.notes)


@pytest.mark.parametrize("pose", [False, True])
def test_mavros(pose, tmp_path):
    """The log has odometry with velocities in body axes, or poses and velocities in world axes."""
    pytest.importorskip("rosbags")
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    make = store.types
    vector, target = make["geometry_msgs/msg/Vector3"], "mavros_msgs/msg/AttitudeTarget"
    body = np.einsum("nji,nj->ni", FLIGHT.R, FLIGHT.v)

    def header(t):
        stamp = make["builtin_interfaces/msg/Time"](*divmod(round(1e9 * (t + 5.0)), 10**9))
        return make["std_msgs/msg/Header"](stamp, "map")

    def messages():
        for k, t in enumerate(FLIGHT.t):
            at, arrival = header(t), round(1e9 * (t + 5.0))
            place = make["geometry_msgs/msg/Pose"](
                make["geometry_msgs/msg/Point"](*FLIGHT.p[k]), make["geometry_msgs/msg/Quaternion"](*Q[k])
            )
            twist = make["geometry_msgs/msg/Twist"](vector(*(FLIGHT.v if pose else body)[k]), vector(*FLIGHT.omega[k]))
            if pose:
                for topic, kind, inner in (("pose", "PoseStamped", place), ("velocity_local", "TwistStamped", twist)):
                    full = f"geometry_msgs/msg/{kind}"
                    yield f"/uav1/mavros/local_position/{topic}", full, arrival, make[full](at, inner)
            else:
                odometry = make["nav_msgs/msg/Odometry"](
                    at, "base_link", make["geometry_msgs/msg/PoseWithCovariance"](place, np.zeros(36)),
                    make["geometry_msgs/msg/TwistWithCovariance"](twist, np.zeros(36)))  # fmt: skip
                yield "/mavros/local_position/odom", "nav_msgs/msg/Odometry", arrival, odometry
            message = {"header": at, "type_mask": 128, "body_rate": vector(*FLIGHT.omega[k]),
                    "thrust": 0.5 * FLIGHT.c[k] / G[2]}  # fmt: skip
            yield f"{'/uav1' * pose}/mavros/setpoint_raw/attitude", target, arrival, message

    definition = {target: "std_msgs/Header header\nuint8 type_mask\ngeometry_msgs/Vector3 body_rate\nfloat32 thrust\n"}
    log = read_flight_log(bag2(tmp_path / "bag", definition, messages(), store))
    assert_is_flight(log, 1e-3)


@pytest.mark.parametrize("kind", ["thrust", "controls"])
def test_px4_before_1_10(kind, tmp_path):
    pytest.importorskip("pyulog")
    topics, stamps = px4_topics(FLIGHT)
    share = 0.5 * FLIGHT.c / G[2]
    message = topics["vehicle_rates_setpoint"]
    del message["thrust_body"]
    topics["sensor_combined"] = {"gyro_rad": ("float[3]", topics.pop("vehicle_angular_velocity")["xyz"][1])}
    if kind == "thrust":
        message["thrust"] = ("float", share)
    else:
        topics["actuator_controls_0"] = {"control": ("float[8]", np.repeat(share[:, None], 8, axis=1))}
    (tmp_path / "old.ulg").write_bytes(ulog(topics, stamps))
    assert_is_flight(read_flight_log(tmp_path / "old.ulg"), 1e-4)


def test_ulog_may_use_other_time_field(tmp_path):
    """The stamps of the topics are late by up to 8 ms, and the field named by the map is exact."""
    pytest.importorskip("pyulog")
    topics, stamps = px4_topics(FLIGHT)
    for fields in topics.values():
        fields["sampled"] = ("uint64_t", stamps)
    late = stamps + np.random.default_rng(0).integers(0, 8000, len(stamps))
    (tmp_path / "late.ulg").write_bytes(ulog(topics, late))
    choice = dataclasses.replace(read_map("px4"), time=Time("sampled", "us"))
    assert_is_flight(read_flight_log(tmp_path / "late.ulg", choice), 1e-4)


def crazyflie(compressed, quaternion):
    """Return columns of its log variables; pitch and its rate are positive nose up."""
    yaw, pitch, roll = Rotation.from_matrix(FLIGHT.R).as_euler("ZYX", degrees=True).T
    message = np.degrees(FLIGHT.omega)
    table = {"timestamp": 1000.0 * FLIGHT.t + 4000.0}
    group, unit = ("stateEstimateZ", 1000.0) if compressed else ("stateEstimate", 1.0)
    for i, axis in enumerate("xyz"):
        table |= {f"{group}.{axis}": unit * FLIGHT.p[:, i], f"{group}.v{axis}": unit * FLIGHT.v[:, i]}
    if quaternion:
        table |= {f"stateEstimate.q{axis}": Q[:, i] for i, axis in enumerate("xyzw")}
    else:
        table |= {"stateEstimate.roll": roll, "stateEstimate.pitch": -pitch, "stateEstimate.yaw": yaw}
    table |= {
        "controller.rollRate": message[:, 0],
        "controller.pitchRate": -message[:, 1],
        "controller.yawRate": message[:, 2],
    }
    if compressed:
        w = 1000.0 * FLIGHT.omega
        table |= {f"stateEstimateZ.rate{name}": s * w[:, i]
                  for i, (name, s) in enumerate((("Roll", 1), ("Pitch", -1), ("Yaw", 1)))}  # fmt: skip
    else:
        table |= {f"gyro.{axis}": message[:, i] for i, axis in enumerate("xyz")}
    return table | {"stabilizer.thrust": 65535.0 * 0.5 * FLIGHT.c / G[2]}


@pytest.mark.parametrize("quaternion", [False, True])
@pytest.mark.parametrize("compressed", [False, True])
def test_crazyflie(compressed, quaternion, tmp_path):
    log = read_flight_log(write_csv(tmp_path / "log.csv", crazyflie(compressed, quaternion)))
    assert_is_flight(log, 1e-5)
    assert log.warnings == ()


def test_crazyswarm_has_poses_without_velocities(tmp_path):
    """The log has poses of motion capture at 100 Hz, and commanded thrust without a header."""
    pytest.importorskip("rosbags")
    from rosbags.typesys import Stores, get_typestore

    store, fine = get_typestore(Stores.ROS2_HUMBLE), fly_once(8.0, dt=0.01)
    make, q = store.types, Rotation.from_matrix(fine.R).as_quat()
    vector = make["geometry_msgs/msg/Vector3"]
    thrust = 65535.0 * 0.5 * fine.c / G[2]

    def messages():
        for k, t in enumerate(fine.t):
            now = round(1e9 * (t + 1e6))
            stamp = make["builtin_interfaces/msg/Time"](*divmod(now, 10**9))
            place = make["geometry_msgs/msg/Pose"](
                make["geometry_msgs/msg/Point"](*fine.p[k]), make["geometry_msgs/msg/Quaternion"](*q[k])
            )
            pose = make["geometry_msgs/msg/PoseStamped"](make["std_msgs/msg/Header"](stamp, "world"), place)
            yield "/cf7/pose", "geometry_msgs/msg/PoseStamped", now, pose
            message = make["geometry_msgs/msg/Twist"](vector(0.0, 0.0, thrust[k]), vector(0.0, 0.0, 0.0))
            yield "/cf7/cmd_vel_legacy", "geometry_msgs/msg/Twist", now + 100, message

    log = read_flight_log(bag2(tmp_path / "bag", {}, messages(), store))
    assert_is_flight(log, 1e-3, command=False)
    assert any("velocity is the derivative of the position" in note for note in log.notes)


MOTORS = """
    time = {{ field = "timestamp", unit = "ms" }}
    position.fields = ["stateEstimate.x", "stateEstimate.y", "stateEstimate.z"]
    attitude.fields = ["stateEstimate.roll", "-stateEstimate.pitch", "stateEstimate.yaw"]
    attitude.form = "roll pitch yaw"
    attitude.unit = "deg"
    thrust = {{ fields = [{}], unit = "share", zero = 1000.0, full = 2000.0, curve = 0.6 }}
    """
FOUR = ", ".join(f'"motor.m{i}"' for i in range(1, 5))


def motors_of(shares):
    """Return pulse widths with the thrust 0.4 s + 0.6 s^2, of motors that differ although their sum does not."""
    square = np.sqrt(0.16 + 2.4 * shares) / 1.2 - 1.0 / 3.0
    return {f"motor.m{i}": 1000.0 * (1.0 + square) for i in range(1, 5)}


def test_motors_give_thrust(tmp_path):
    table = crazyflie(False, False) | motors_of(0.5 * FLIGHT.c / G[2])
    choice = tmp_path / "map.toml"
    choice.write_text(MOTORS.format(FOUR))
    log = read_flight_log(write_csv(tmp_path / "log.csv", table), read_map(choice))
    assert log.full_thrust == pytest.approx(2.0 * G[2], rel=1e-2)
    np.testing.assert_allclose(
        log.c[log.valid] / G[2], np.interp(log.t, FLIGHT.t, FLIGHT.c)[log.valid] / G[2], atol=0.1
    )
    at = np.sqrt(0.16 + 1.2) / 1.2 - 1.0 / 3.0
    assert any(f"hover at {1000 * (1 + at):.0f}" in note for note in log.notes)
    choice.write_text(MOTORS.format(FOUR).replace("curve", f"hover = {1000.0 * (1.0 + at)}, curve"))
    told = read_flight_log(tmp_path / "log.csv", read_map(choice))
    assert told.full_thrust == pytest.approx(2.0 * G[2], rel=1e-6)


def test_three_motors_are_refused(tmp_path):
    choice = tmp_path / "map.toml"
    choice.write_text(MOTORS.format('"motor.m1", "motor.m2", "motor.m3"'))
    table = crazyflie(False, False) | motors_of(0.5 * FLIGHT.c / G[2])
    with pytest.raises(LogError, match=r"thrust needs 1 number or, .*one for each of 4 motors or more; .* hold 3"):
        read_flight_log(write_csv(tmp_path / "log.csv", table), read_map(choice))


@pytest.mark.parametrize(("period", "jitter"), [(0.02, 0.006), (0.004, 0.003)])
def test_jitter_of_regular_messages_is_removed(period, jitter):
    rng = np.random.default_rng(0)
    sending = 1.7e9 + period * np.arange(1200)
    arrival = np.maximum.accumulate(sending + 0.003 + np.abs(rng.normal(0.0, jitter, 1200)))
    result, even = evenly(arrival)
    assert even
    assert np.all(np.diff(result) > 0.0)
    np.testing.assert_allclose(result, sending + 0.003, atol=5e-4)


@pytest.mark.parametrize("kind", ["uneven", "lost", "few"])
def test_irregular_messages_use_time_of_reception(kind):
    rng = np.random.default_rng(0)
    arrival = {
        "uneven": np.cumsum(rng.uniform(0.0, 0.04, 1000)),
        "lost": np.delete(0.02 * np.arange(1000), 500),
        "few": 0.02 * np.arange(20),
    }[kind]
    result, even = evenly(arrival)
    assert not even
    np.testing.assert_array_equal(result, arrival)


def test_thrust_without_header_and_odometry_with_header(tmp_path):
    """The thrust is a number of std_msgs, received up to 20 ms late."""
    pytest.importorskip("rosbags")
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    make, rng, last = store.types, np.random.default_rng(0), 0
    vector = make["geometry_msgs/msg/Vector3"]
    flight = fly_once(12.0, size=2.0)
    q = Rotation.from_matrix(flight.R).as_quat()

    def messages():
        nonlocal last
        for k, t in enumerate(flight.t):
            now = round(1e9 * (t + 1.7e9))
            stamp = make["builtin_interfaces/msg/Time"](*divmod(now, 10**9))
            place = make["geometry_msgs/msg/Pose"](
                make["geometry_msgs/msg/Point"](*flight.p[k]), make["geometry_msgs/msg/Quaternion"](*q[k])
            )
            twist = make["geometry_msgs/msg/Twist"](vector(*flight.v[k]), vector(*flight.omega[k]))
            odometry = make["nav_msgs/msg/Odometry"](
                make["std_msgs/msg/Header"](stamp, "map"), "base",
                make["geometry_msgs/msg/PoseWithCovariance"](place, np.zeros(36)),
                make["geometry_msgs/msg/TwistWithCovariance"](twist, np.zeros(36)))  # fmt: skip
            yield "/odom", "nav_msgs/msg/Odometry", now, odometry
            last = max(now + int(6e6 * abs(rng.normal())), last + 1000)
            yield "/thrust", "std_msgs/msg/Float64", last, make["std_msgs/msg/Float64"](flight.c[k])

    path = bag2(tmp_path / "bag", {}, messages(), store)
    (tmp_path / "map.toml").write_text("""
    position.fields = ["/odom.pose.pose.position"]
    velocity.fields = ["/odom.twist.twist.linear"]
    attitude = { fields = ["/odom.pose.pose.orientation"], form = "xyzw" }
    thrust = { fields = ["/thrust.data"], unit = "m/s^2" }
    """)
    log = read_flight_log(path, read_map(tmp_path / "map.toml"))
    assert any("/thrust has no stamps; its times are those of reception, without" in note for note in log.notes)
    assert np.abs(np.asarray(rows_of(log).a_res)[log.valid]).max() < 0.1
