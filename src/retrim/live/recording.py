"""A live flight as an MCAP file with messages of ROS 2, for Foxglove, PlotJuggler, rerun and ``ros2 bag``.

Needs the extra ``mcap``.
"""

import os
import tempfile
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import ConfigError
from ..onboard.guard import Mode
from ..onboard.messages import ACCOUNTS, COMMAND, MEASURED, TRUE
from ..runtime.events import Event
from .scene import quaternion

FRAME = "world"


def check_recording(path: Path) -> Path:
    """Return where a recording goes, before anything is flown.

    Raises:
        ConfigError: It cannot be written there, or what writes it is not installed.
    """
    if path.suffix != ".mcap":
        raise ConfigError(f"--record {path}: the name must end with .mcap")
    if find_spec("rosbags") is None:
        raise ConfigError("--record needs rosbags: pip install 'retrim[mcap]'")
    if path.is_dir():
        raise ConfigError(f"--record {path}: it is a folder")
    if not path.parent.is_dir() or not os.access(path.parent, os.W_OK):
        raise ConfigError(f"--record {path}: nothing can be written in {path.parent}")
    return path


def write_recording(path: Path, rows: np.ndarray, target: np.ndarray, events: Sequence[Event]) -> None:
    """Write the ticks and events of a flight; the file appears when it is whole.

    Args:
        path: The file.
        rows: Ticks, in the columns of :data:`retrim.onboard.messages.COLUMNS`.
        target: Where the vehicle should have been at each, world [m], (n, 3).
        events: What happened.
    """
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    types = get_typestore(Stores.ROS2_JAZZY)
    make = _Messages(types.types)
    with tempfile.TemporaryDirectory(dir=path.parent) as place:
        bag = Path(place) / "flight"
        with Writer(bag, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
            topics: dict[str, Any] = {}

            def add(topic: str, t: float, message: Any) -> None:
                if topic not in topics:
                    topics[topic] = writer.add_connection(topic, message.__msgtype__, typestore=types)
                writer.write(topics[topic], _ns(t), types.serialize_cdr(message, message.__msgtype__))

            for row, place_of in zip(rows, target, strict=True):
                t, x = float(row[1]), row[MEASURED]
                add("/measured/pose", t, make.pose(t, x))
                add("/measured/velocity", t, make.twist(t, x[12:15], np.zeros(3)))
                add("/true/pose", t, make.pose(t, row[TRUE]))
                add("/reference", t, make.point(t, place_of))
                add("/command", t, make.twist(t, np.array([0.0, 0.0, row[COMMAND][0]]), row[COMMAND][1:]))
                add("/error", t, make.number(float(np.linalg.norm(row[TRUE][:3] - place_of))))
                add("/flown_by", t, make.text(Mode(int(row[-1])).name.lower()))
                add("/age/policy", t, make.number(float(row[ACCOUNTS["policy_age"]])))
            for event in sorted(events, key=lambda event: event.t):
                add("/events", max(0.0, event.t), make.text(f"{event.kind}: {event.note}"))
        next(bag.glob("*.mcap")).replace(path)


class _Messages:
    """Messages of ROS 2; thrust is in linear.z of a command [m/s^2], body rates are its angular part [rad/s]."""

    def __init__(self, types: Any) -> None:
        self._types = types

    def pose(self, t: float, x: np.ndarray) -> Any:
        w, *xyz = quaternion(x[3:12].reshape(3, 3))
        orientation = self._of("geometry_msgs/msg/Quaternion", *map(float, xyz), float(w))
        pose = self._of("geometry_msgs/msg/Pose", self._xyz("Point", x[:3]), orientation)
        return self._of("geometry_msgs/msg/PoseStamped", self._header(t), pose)

    def twist(self, t: float, linear: np.ndarray, angular: np.ndarray) -> Any:
        twist = self._of("geometry_msgs/msg/Twist", self._xyz("Vector3", linear), self._xyz("Vector3", angular))
        return self._of("geometry_msgs/msg/TwistStamped", self._header(t), twist)

    def point(self, t: float, p: np.ndarray) -> Any:
        return self._of("geometry_msgs/msg/PointStamped", self._header(t), self._xyz("Point", p))

    def number(self, value: float) -> Any:
        return self._of("std_msgs/msg/Float64", value)

    def text(self, value: str) -> Any:
        return self._of("std_msgs/msg/String", value)

    def _header(self, t: float) -> Any:
        stamp = self._of("builtin_interfaces/msg/Time", *divmod(_ns(t), 10**9))
        return self._of("std_msgs/msg/Header", stamp, FRAME)

    def _xyz(self, kind: str, a: np.ndarray) -> Any:
        return self._of(f"geometry_msgs/msg/{kind}", *map(float, a))

    def _of(self, kind: str, *values: Any) -> Any:
        return self._types[kind](*values)


def _ns(t: float) -> int:
    return round(1e9 * t)
