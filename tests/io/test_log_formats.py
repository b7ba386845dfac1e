"""The same flight from every format: bags of ROS 1 and 2, MCAP, NPZ, and a ULog written byte by byte."""

import contextlib

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fake_bytes import px4_topics, ulog
from fake_log import G, fly_once
from retrim.errors import LogError, RetrimError
from retrim.io.logs import read_flight_log, read_map
from retrim.io.logs.recording import Recording, write_mcap, write_npz

FLIGHT = fly_once(6.0)
N = len(FLIGHT.t)


def assert_agrees(log, places=1e-6):
    shift = round((log.t[0] - 0.0) / 0.02)
    for result, true_state in ((log.p, FLIGHT.p), (log.R, FLIGHT.R), (log.v, FLIGHT.v), (log.c, FLIGHT.c)):
        np.testing.assert_allclose(result, true_state[shift : shift + len(result)], atol=places)
    np.testing.assert_allclose(log.command, FLIGHT.omega[: len(log.command)], atol=places)
    assert log.valid[3:-3].all()


@pytest.fixture(scope="module")
def recording():
    states = np.concatenate([FLIGHT.p, FLIGHT.R.reshape(N, 9), FLIGHT.v], axis=1)
    command = np.concatenate([FLIGHT.c[:, None], FLIGHT.omega], axis=1)
    return Recording(FLIGHT.t, states, states, np.zeros(N), command, np.zeros(N))


def test_retrim_npz_log(recording, tmp_path):
    write_npz(tmp_path / "flight.npz", recording)
    assert_agrees(read_flight_log(tmp_path / "flight.npz"))


def test_retrim_mcap_recording(recording, tmp_path):
    pytest.importorskip("rosbags")
    write_mcap(tmp_path / "flight.mcap", recording)
    assert_agrees(read_flight_log(tmp_path / "flight.mcap"))


@pytest.mark.parametrize(
    ("times", "text"), [(np.zeros((N, 0)), "not an array of numbers over time"), (np.zeros((N, 2)), "holds 2 numbers")]
)
def test_times_of_npz_log_are_one_column(recording, times, text, tmp_path):
    write_npz(tmp_path / "flight.npz", recording)
    with np.load(tmp_path / "flight.npz") as arrays:
        np.savez(tmp_path / "other.npz", **(dict(arrays) | {"t": times}))
    with pytest.raises(LogError, match=f"other.npz: 't' .*{text}"):
        read_flight_log(tmp_path / "other.npz")


@pytest.mark.parametrize("write", [write_npz, write_mcap])
@pytest.mark.parametrize(
    ("ms", "ages"), [(20, (15,)), (20, (25,)), (20, (30,)), (10, (15,)), (10, (25,)), (10, (30,)), (10, (15, 25)),
                     (20, (10, 30)), (10, (5, 30))]
)  # fmt: skip
def test_retrim_recording_of_delayed_states(write, ms, ages, tmp_path):
    """States are older than a tick, repeated or late, and the stated age is wrong by tenths of a millisecond."""
    if write is write_mcap:
        pytest.importorskip("rosbags")
    fine, before = fly_once(6.0, dt=1e-3), 100  # ms of flight before the recording
    ticks = np.arange(before, len(fine.t), ms)
    age = np.resize(ages, len(ticks))
    states = np.concatenate([fine.p, fine.R.reshape(-1, 9), fine.v], axis=1)
    command = np.concatenate([fine.c[:, None], fine.omega], axis=1)[ticks]
    jitter = np.random.default_rng(0).uniform(-3e-4, 3e-4, len(ticks))
    t, display = 1e-3 * (ticks - before), states[ticks - age]
    path = tmp_path / ("flight.npz" if write is write_npz else "flight.mcap")
    write(path, Recording(t, display, states[ticks], 1e-3 * age + jitter, command, np.zeros(len(t))))
    log = read_flight_log(path, dt=1e-3 * ms)
    assert log.valid[3:-3].all()
    assert any("not newer than the one before" in note for note in log.notes) == (len(ages) > 1)

    def true_state(start):
        """Return position, velocity and thrust at the times of a log that begins at ``start``."""
        columns = np.concatenate([fine.p, fine.v, fine.c[:, None]], axis=1).T
        return np.stack([np.interp(start + log.t[5:-5], fine.t, column) for column in columns], axis=1)

    # The clock of the log begins with its first state; the log does not state the time of this state.
    result = np.concatenate([log.p, log.v, log.c[:, None]], axis=1)[5:-5]
    error = min((np.abs(result - true_state(1e-3 * start)).max(axis=0) for start in range(50, 200)), key=np.sum)
    assert error[:3].max() < 3e-3
    assert error[3:6].max() < 0.03
    assert error[6] < 0.1


@pytest.mark.parametrize("name", ["flight.bag", "flight.db3", "flight"])
def test_ros_bags(name, tmp_path):
    """Odometry as from MAVROS: velocities in body axes, and thrust as a fraction."""
    rosbags = pytest.importorskip("rosbags.typesys")
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2

    one = name.endswith(".bag")
    types = rosbags.get_typestore(rosbags.Stores.ROS1_NOETIC if one else rosbags.Stores.ROS2_JAZZY)
    name_of = "mavros_msgs/msg/AttitudeTarget"
    definition = "std_msgs/Header header\ngeometry_msgs/Vector3 body_rate\nfloat32 thrust"
    types.register(rosbags.get_types_from_msg(definition, name_of))
    make = types.types
    vector = make["geometry_msgs/msg/Vector3"]
    path = tmp_path / name
    writer = Writer1(path) if one else Writer2(tmp_path / "whole", version=9, storage_plugin=StoragePlugin.SQLITE3)
    body = np.einsum("nji,nj->ni", FLIGHT.R, FLIGHT.v)
    q = Rotation.from_matrix(FLIGHT.R).as_quat()

    def header(t):
        stamp = make["builtin_interfaces/msg/Time"](*divmod(round(1e9 * (t + 5.0)), 10**9))
        return make["std_msgs/msg/Header"](*((0, stamp, "map") if one else (stamp, "map")))

    def odometry(k):
        pose = make["geometry_msgs/msg/Pose"](
            make["geometry_msgs/msg/Point"](*FLIGHT.p[k]), make["geometry_msgs/msg/Quaternion"](*q[k])
        )
        twist = make["geometry_msgs/msg/Twist"](vector(*body[k]), vector(*FLIGHT.omega[k]))
        nothing = np.zeros(36)
        return make["nav_msgs/msg/Odometry"](
            header(FLIGHT.t[k]), "base_link",
            make["geometry_msgs/msg/PoseWithCovariance"](pose, nothing),
            make["geometry_msgs/msg/TwistWithCovariance"](twist, nothing),
        )  # fmt: skip

    def capture(k):
        fields = {
            "header": header(FLIGHT.t[k]),
            "body_rate": vector(*FLIGHT.omega[k]),
            "thrust": 0.45 * FLIGHT.c[k] / G[2],
        }
        return make[name_of](**fields)

    serialise = types.serialize_ros1 if one else types.serialize_cdr
    with writer:
        topics = [
            (writer.add_connection(topic, kind, typestore=types), kind, message)
            for topic, kind, message in (
                ("/mavros/local_position/odom", "nav_msgs/msg/Odometry", odometry),
                ("/mavros/setpoint_raw/attitude", name_of, capture),
            )
        ]
        for k in range(N):
            for connection, kind, message in topics:
                writer.write(connection, round(1e9 * (FLIGHT.t[k] + 5.0)), serialise(message(k), kind))
    if name == "flight.db3":
        path = next((tmp_path / "whole").glob("*.db3"))
    elif not one:
        path = tmp_path / "whole"
    log = read_flight_log(path, read_map("mavros"))
    assert_agrees(log, 3e-3)
    assert log.full_thrust == pytest.approx(G[2] / 0.45, rel=1e-3)
    with pytest.raises(LogError, match=r"no field '/odom'; there are /mavros/local_position/odom"):
        read_flight_log(path, read_map_with(tmp_path, "/odom.pose.pose.position"))
    with pytest.raises(LogError, match=r"no field '/mavros/local_position/odom.pose.positon'; "):
        read_flight_log(path, read_map_with(tmp_path, "/mavros/local_position/odom.pose.positon"))
    with pytest.raises(LogError, match="holds no numbers; it has pose, covariance"):
        read_flight_log(path, read_map_with(tmp_path, "/mavros/local_position/odom.pose"))


def read_map_with(folder, position):
    text = f"""
    position.fields = ["{position}"]
    velocity = {{ fields = ["/mavros/local_position/odom.twist.twist.linear"], axes = "body" }}
    attitude = {{ fields = ["/mavros/local_position/odom.pose.pose.orientation"], form = "xyzw" }}
    thrust = {{ fields = ["/mavros/setpoint_raw/attitude.thrust"], unit = "share" }}
    """
    (folder / "other.toml").write_text(text)
    return read_map(folder / "other.toml")


def px4_ulog(flight):
    """Return a ULog of PX4, whose states have sample times and arrive 0.7 ms later."""
    topics, stamps = px4_topics(flight)
    states = topics.keys() - {"vehicle_rates_setpoint"}
    topics |= {name: {"timestamp_sample": ("uint64_t", stamps), **topics[name]} for name in states}
    return ulog(topics, {name: stamps + 700 * (name in states) for name in topics})


def test_px4_ulog(tmp_path):
    pytest.importorskip("pyulog")
    path = tmp_path / "flight.ulg"
    path.write_bytes(px4_ulog(FLIGHT))
    log = read_flight_log(path)
    assert_agrees(log, 1e-2)
    np.testing.assert_allclose(log.rates, FLIGHT.omega, atol=1e-5)
    assert log.full_thrust == pytest.approx(2.0 * G[2], rel=1e-3)


def test_damaged_ulog_gives_flight_or_one_line(tmp_path):
    pytest.importorskip("pyulog")
    whole, rng = px4_ulog(FLIGHT), np.random.default_rng(0)
    path = tmp_path / "flight.ulg"
    for k in range(25):
        data = bytearray(whole[: int(rng.integers(20, len(whole)))])
        for place in rng.integers(16, len(data), k % 4):
            data[place] ^= 0xFF
        path.write_bytes(bytes(data))
        with contextlib.suppress(RetrimError):
            log = read_flight_log(path)
            assert np.isfinite(log.p[log.valid]).all()


def test_ulog_whose_last_message_is_incomplete_is_read_to_its_end(tmp_path):
    """A parser that steps back from the end by the stated size of an incomplete message would never end."""
    pytest.importorskip("pyulog")
    path, whole = tmp_path / "flight.ulg", px4_ulog(FLIGHT)
    head, unknown = whole[:16] + bytes(30_000), b"\x64\0\0" + bytes(20)
    for data in (head + unknown, head + b"\xff\xff\0" + bytes(20), whole[:16] + unknown, whole[:16] + b"\xff\xffA"):
        path.write_bytes(data)
        with pytest.raises(LogError, match=r"flight.ulg: (cannot be read as ULog|this ULog holds no topic)"):
            read_flight_log(path)
    path.write_bytes(whole + b"\xff\xff\0" + bytes(20))
    assert_agrees(read_flight_log(path), 1e-2)


@pytest.mark.parametrize("kind", ["mcap", "npz"])
def test_damaged_recording_gives_flight_or_one_line(recording, kind, tmp_path):
    pytest.importorskip("rosbags")
    path, rng = tmp_path / f"flight.{kind}", np.random.default_rng(0)
    (write_mcap if kind == "mcap" else write_npz)(path, recording)
    whole = path.read_bytes()
    for k in range(20):
        data = bytearray(whole[: int(rng.integers(8, len(whole)))] if k % 2 else whole)
        for place in rng.integers(0, len(data), 3):
            data[place] ^= 0xFF
        path.write_bytes(bytes(data))
        with contextlib.suppress(RetrimError):
            log = read_flight_log(path)
            assert np.isfinite(log.p[log.valid]).all()
