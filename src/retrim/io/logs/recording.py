"""Writes a flight as files for other programs: MCAP with ROS 2 messages, and NPZ with the same data.

Foxglove, PlotJuggler, rerun and ``ros2 bag`` open MCAP files. Writing MCAP needs the extra ``mcap``. ``retrim replay``
reads both formats.
"""

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ...runtime.events import Event
from ..files import npz_bytes, write_whole

FRAME = "world"


@dataclass(frozen=True)
class Recording:
    """Ticks and events of a flight; a state consists of p [m], R (row by row) and v [m/s], in the world frame."""

    t: np.ndarray
    """Times from the start [s], (n,)."""
    measured: np.ndarray
    """States that the pilot received, (n, 15)."""
    true: np.ndarray
    """True states, (n, 15)."""
    age: np.ndarray
    """Age of the received states [s], (n,)."""
    command: np.ndarray
    """Resulting command: c [m/s^2], omega [rad/s], (n, 4)."""
    error: np.ndarray
    """The task's error [m], (n,)."""
    target: np.ndarray | None = None
    """The vehicle's target position in the world frame [m], (n, 3)."""
    controllers: Sequence[str] | None = None
    """Name of the controller that commanded the vehicle, (n,)."""
    policy_age: np.ndarray | None = None
    """Age of the flight data from which the policy was learned [s], (n,)."""
    events: Sequence[Event] = ()
    terminated: bool = False


def write_npz(path: Path, flight: Recording) -> None:
    """Write arrays over time; the file appears once it is complete."""
    arrays = {"t": flight.t, "u": flight.command, "age": flight.age, "error": flight.error}
    for end, x in (("", flight.true), ("_measured", flight.measured)):
        arrays |= {f"p{end}": x[:, :3], f"R{end}": x[:, 3:12].reshape(-1, 3, 3), f"v{end}": x[:, 12:15]}
    if flight.target is not None:
        arrays["target"] = flight.target
    write_whole(path, npz_bytes({"terminated": flight.terminated, **arrays}, compressed=True))


def write_mcap(path: Path, flight: Recording) -> None:
    """Write ROS 2 messages; the file appears once it is complete.

    Times are those of the flight. If the first states were measured before the flight began, all times are shifted
    later, so that stamps are neither negative nor zero; ROS readers treat a zero stamp as missing.
    """
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    types = get_typestore(Stores.ROS2_JAZZY)
    make = _Messages(types.types)
    rotations = [quaternions(x) for x in (flight.measured, flight.true)]
    with tempfile.TemporaryDirectory(dir=path.parent) as place:
        bag = Path(place) / "flight"
        with Writer(bag, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
            topics: dict[str, Any] = {}

            def add(topic: str, t: float, message: Any) -> None:
                if topic not in topics:
                    topics[topic] = writer.add_connection(topic, message.__msgtype__, typestore=types)
                writer.write(topics[topic], _ns(t), types.serialize_cdr(message, message.__msgtype__))

            first = float(np.min(flight.t - flight.age, initial=0.0))
            later = 0.0 if first == 0.0 else 1e-9 - first
            for k, t in enumerate((flight.t + later).tolist()):
                x, truth, u = flight.measured[k], flight.true[k], flight.command[k]
                stamp = t - float(
                    flight.age[k]
                )  # the header has the time of the state, and the log that of its arrival
                add("/measured/pose", t, make.pose(stamp, x, rotations[0][k]))
                add("/measured/velocity", t, make.twist(stamp, x[12:15], np.zeros(3)))
                add("/true/pose", t, make.pose(t, truth, rotations[1][k]))
                add("/true/velocity", t, make.twist(t, truth[12:15], np.zeros(3)))
                add("/command", t, make.twist(t, np.array([0.0, 0.0, u[0]]), u[1:]))
                add("/error", t, make.number(float(flight.error[k])))
                if flight.target is not None:
                    add("/reference", t, make.point(t, flight.target[k]))
                if flight.controllers is not None:
                    add("/flown_by", t, make.text(flight.controllers[k]))
                if flight.policy_age is not None:
                    add("/age/policy", t, make.number(float(flight.policy_age[k])))
            for event in sorted(flight.events, key=lambda event: event.t):
                add("/events", max(0.0, event.t) + later, make.text(f"{event.kind}: {event.note}"))
        next(bag.glob("*.mcap")).replace(path)


def quaternions(x: np.ndarray) -> np.ndarray:
    """Return the states' attitudes as quaternions x, y, z, w, (n, 4); NaN for an attitude that is not finite."""
    from scipy.spatial.transform import Rotation  # local, because it takes as long to import as all of retrim

    R = x[:, 3:12].reshape(-1, 3, 3)
    is_finite = np.isfinite(R).all(axis=(1, 2))
    result = np.full((len(R), 4), np.nan)
    if is_finite.any():
        result[is_finite] = Rotation.from_matrix(R[is_finite]).as_quat()
    return result


class _Messages:
    """Builds ROS 2 messages; the thrust command is in linear.z [m/s^2] and the body rates are in angular [rad/s]."""

    def __init__(self, types: Any) -> None:
        self._types = types

    def pose(self, t: float, x: np.ndarray, q: np.ndarray) -> Any:
        orientation = self._of("geometry_msgs/msg/Quaternion", *map(float, q))
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
