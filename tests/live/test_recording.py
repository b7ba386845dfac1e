"""A recording is the flight: an independent reader finds every tick, in the form in which other viewers expect it."""

import numpy as np
import pytest

from retrim.errors import ConfigError
from retrim.live.recording import check_recording, write_recording
from retrim.onboard.guard import Mode
from retrim.onboard.messages import COLUMNS, COMMAND, MEASURED, TRUE
from retrim.runtime.events import Event


def ticks(n):
    rng = np.random.default_rng(0)
    rows = np.zeros((n, len(COLUMNS)))
    rows[:, 0], rows[:, 1], rows[:, -1] = np.arange(n), 0.02 * np.arange(n), Mode.POLICY
    turned = np.linalg.qr(rng.normal(size=(n, 3, 3)))[0]
    turned *= np.linalg.det(turned)[:, None, None]
    for part in (MEASURED, TRUE):
        rows[:, part] = np.concatenate([rng.normal(size=(n, 3)), turned.reshape(n, 9), rng.normal(size=(n, 3))], axis=1)
    rows[:, COMMAND] = rng.normal(size=(n, 4))
    return rows


def test_what_is_written_is_read(tmp_path):
    reading = pytest.importorskip("rosbags.highlevel")
    rows, path = ticks(40), tmp_path / "flight.mcap"
    target = np.tile([0.0, 0.0, 1.0], (40, 1))
    write_recording(path, rows, target, [Event(0.3, "policy", "version 1"), Event(0.1, "knobs", "push 1 0 0")])
    assert [p.name for p in tmp_path.iterdir()] == ["flight.mcap"]
    from rosbags.typesys import Stores, get_typestore

    found = {}
    with reading.AnyReader([path], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
        for connection, t, raw in reader.messages():
            message = reader.deserialize(raw, connection.msgtype)
            found.setdefault(connection.topic, []).append((1e-9 * t, message))
    poses = found["/measured/pose"]
    np.testing.assert_allclose([t for t, _ in poses], rows[:, 1], atol=1e-9)
    shown = [[m.pose.position.x, m.pose.position.y, m.pose.position.z] for _, m in poses]
    np.testing.assert_allclose(shown, rows[:, MEASURED][:, :3])
    for (_, m), row in zip(poses, rows, strict=True):
        q = m.pose.orientation
        z = [2 * (q.x * q.z + q.w * q.y), 2 * (q.y * q.z - q.w * q.x), 1 - 2 * (q.x**2 + q.y**2)]
        np.testing.assert_allclose(z, row[MEASURED][3:12].reshape(3, 3)[:, 2], atol=1e-9)
    np.testing.assert_allclose([m.twist.linear.z for _, m in found["/command"]], rows[:, COMMAND][:, 0])
    np.testing.assert_allclose(
        [m.data for _, m in found["/error"]], np.linalg.norm(rows[:, TRUE][:, :3] - target, axis=1)
    )
    assert [m.data for _, m in found["/events"]] == ["knobs: push 1 0 0", "policy: version 1"]
    assert {m.data for _, m in found["/flown_by"]} == {"policy"}


def test_where_nothing_can_be_recorded_is_named(tmp_path):
    with pytest.raises(ConfigError, match=r"must end with \.mcap"):
        check_recording(tmp_path / "flight.bag")
    pytest.importorskip("rosbags")
    with pytest.raises(ConfigError, match="nothing can be written in"):
        check_recording(tmp_path / "nowhere" / "flight.mcap")
    assert check_recording(tmp_path / "flight.mcap") == tmp_path / "flight.mcap"
