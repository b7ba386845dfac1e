"""A recording contains the flight: an independent reader finds every tick in the expected form."""

import numpy as np
import pytest

from retrim.errors import ConfigError
from retrim.io.logs.recording import Recording, write_mcap, write_npz
from retrim.io.logs.viewers import check_recording, record
from retrim.runtime.events import Event

N = 40


def recording():
    rng = np.random.default_rng(0)
    rotations = np.linalg.qr(rng.normal(size=(2, N, 3, 3)))[0]
    rotations *= np.linalg.det(rotations)[..., None, None]
    states = [np.concatenate([rng.normal(size=(N, 3)), R.reshape(N, 9), rng.normal(size=(N, 3))], 1) for R in rotations]
    events = [Event(0.3, "policy", "version 1"), Event(0.1, "knobs", "push 1 0 0")]
    return Recording(
        0.02 * np.arange(N), *states, np.full(N, 0.01), rng.normal(size=(N, 4)), rng.uniform(size=N),
        rng.normal(size=(N, 3)), ["policy"] * N, rng.uniform(size=N), events,
    )  # fmt: skip


def test_recording_is_readable_by_independent_reader(tmp_path):
    pytest.importorskip("rosbags")
    make_reader = pytest.importorskip("mcap.reader").make_reader
    decoders = [pytest.importorskip("mcap_ros2.decoder").DecoderFactory()]
    flight, path = recording(), tmp_path / "flight.mcap"
    write_mcap(path, flight)
    assert [p.name for p in tmp_path.iterdir()] == ["flight.mcap"]
    result, schemas = {}, {}
    with path.open("rb") as file:
        for schema, channel, message, content in make_reader(file, decoder_factories=decoders).iter_decoded_messages():
            result.setdefault(channel.topic, []).append((1e-9 * message.log_time, content))
            schemas[channel.topic] = schema.name
    poses = result["/measured/pose"]
    assert schemas["/measured/pose"] == "geometry_msgs/msg/PoseStamped"
    came = np.array([t for t, _ in poses])
    np.testing.assert_allclose(came - came[0], flight.t, atol=1e-9)
    stamps = [m.header.stamp.sec + 1e-9 * m.header.stamp.nanosec for _, m in poses]
    np.testing.assert_allclose(stamps, came - 0.01, atol=1e-9)
    np.testing.assert_allclose([t for t, _ in result["/events"]], came[0] + np.array([0.1, 0.3]), atol=1e-9)
    display = [[m.pose.position.x, m.pose.position.y, m.pose.position.z] for _, m in poses]
    np.testing.assert_allclose(display, flight.measured[:, :3])
    for (_, m), row in zip(poses, flight.measured, strict=True):
        q = m.pose.orientation
        z = [2 * (q.x * q.z + q.w * q.y), 2 * (q.y * q.z - q.w * q.x), 1 - 2 * (q.x**2 + q.y**2)]
        np.testing.assert_allclose(z, row[3:12].reshape(3, 3)[:, 2], atol=1e-9)
    np.testing.assert_allclose([m.twist.linear.z for _, m in result["/command"]], flight.command[:, 0])
    np.testing.assert_allclose([m.twist.angular.y for _, m in result["/command"]], flight.command[:, 2])
    np.testing.assert_allclose([m.data for _, m in result["/error"]], flight.error)
    assert [m.data for _, m in result["/events"]] == ["knobs: push 1 0 0", "policy: version 1"]
    assert {m.data for _, m in result["/flown_by"]} == {"policy"}


def test_rerun_reader_finds_flight(tmp_path):
    """The timeline is in seconds since the start."""
    pytest.importorskip("rerun")
    from rerun.chunk import RrdReader

    flight, path = recording(), tmp_path / "flight.rrd"
    record(path, flight)
    assert [p.name for p in tmp_path.iterdir()] == ["flight.rrd"]
    reader = RrdReader(path)
    assert len(reader.recordings()) == len(reader.blueprints()) == 1
    result = {}
    for chunk in reader.stream():
        columns = chunk.to_record_batch().to_pydict()
        for name, values in columns.items():
            result.setdefault(chunk.entity_path, {}).setdefault(name.rpartition(":")[2], []).extend(values)

    def seconds(entity):
        return [t.total_seconds() for t in result[entity]["flight"]]

    for entity in ("/world/vehicle", "/world/measured", "/error", "/command/rates/y"):
        np.testing.assert_allclose(seconds(entity), flight.t, atol=1e-6)
    places = np.array([v[0] for v in result["/world/vehicle"]["translation"]])
    np.testing.assert_allclose(places, flight.true[:, :3], rtol=1e-6)
    x, y, z, w = np.array([v[0] for v in result["/world/vehicle"]["quaternion"]]).T
    up = np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x**2 + y**2)], axis=1)
    np.testing.assert_allclose(up, flight.true[:, 3:12].reshape(-1, 3, 3)[:, :, 2], atol=1e-6)
    np.testing.assert_allclose([v[0] for v in result["/command/rates/y"]["scalars"]], flight.command[:, 2])
    np.testing.assert_allclose([v[0] for v in result["/error"]["scalars"]], flight.error)
    message = ["flown by policy", "knobs: push 1 0 0", "policy: version 1"]
    assert [v[0] for v in result["/events"]["text"]] == message
    np.testing.assert_allclose(seconds("/events"), [0.0, 0.1, 0.3], atol=1e-6)


def test_arrays_contain_flight(tmp_path):
    flight, path = recording(), tmp_path / "flight.npz"
    write_npz(path, flight)
    assert [p.name for p in tmp_path.iterdir()] == ["flight.npz"]
    with np.load(path) as file:
        np.testing.assert_array_equal(file["R_measured"].reshape(N, 9), flight.measured[:, 3:12])
        np.testing.assert_array_equal(file["v"], flight.true[:, 12:])
        np.testing.assert_array_equal(file["u"], flight.command)


def test_unwritable_recording_is_refused(tmp_path):
    with pytest.raises(ConfigError, match=r"must end with \.mcap or \.rrd"):
        check_recording(tmp_path / "flight.bag")
    pytest.importorskip("rosbags")
    with pytest.raises(ConfigError, match="files cannot be written to"):
        check_recording(tmp_path / "nowhere" / "flight.mcap")
    check_recording(None)
    check_recording(tmp_path / "flight.mcap")


def test_missing_viewer_is_reported(tmp_path, monkeypatch):
    monkeypatch.setattr("retrim.io.logs.viewers.find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r"flight\.rrd needs rerun: pip install rerun-sdk"):
        check_recording(tmp_path / "flight.rrd")
