"""Bags of ROS 1 and ROS 2, and MCAP files with messages of ROS. Needs the extra ``logs``.

A field is a topic and a path in its messages, as ``/odom.pose.pose.position``; vectors and quaternions are read whole,
and ``[0]`` is an element of an array. The time is that of the header, or else that of the recording.
"""

import re
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import LogError
from .series import Clock, Series, missing_field

NANOSECOND = 1e-9
ORDER = ("x", "y", "z", "w")


def read_bag(
    path: Path, wanted: Mapping[str, Sequence[str]], time: Clock | None
) -> tuple[dict[str, Series], list[str]]:
    """Read topics of a bag; see :class:`~retrim.io.logs.series.LogReader`. Times are those of the messages."""
    if find_spec("rosbags") is None:
        raise LogError(f"{path}: a bag needs rosbags: pip install 'retrim[logs]'")
    asked = {name for fields in wanted.values() for name in fields}
    try:
        samples = _samples(path, asked)
    except LogError:
        raise
    except Exception as error:  # whatever its parsers meet in bytes that are no bag
        hint = "; `mcap recover` mends a file whose recorder was killed" if path.suffix == ".mcap" else ""
        raise LogError(f"{path}: cannot be read as a bag ({type(error).__name__}: {error}){hint}") from error
    found = dict[str, Series]()
    for what, fields in wanted.items():
        if len({name.partition(".")[0] for name in fields}) > 1:
            raise LogError(f"{path}: the fields of {what} come from several topics: {', '.join(fields)}")
        times, first = samples[fields[0]]
        found[what] = Series(times, np.concatenate([first, *(samples[name][1] for name in fields[1:])], axis=1))
    return found, []


def _samples(path: Path, asked: set[str]) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return times [s] and numbers of each field."""
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    per_topic = dict[str, list[str]]()
    for name in sorted(asked):
        topic, _, field = name.partition(".")
        if not field:
            raise LogError(f"{path}: field {name!r} must be a topic and a path, as /odom.pose.pose.position")
        per_topic.setdefault(topic, []).append(name)
    taken: dict[str, list[list[float]]] = {name: [] for name in asked}
    times: dict[str, list[float]] = {topic: [] for topic in per_topic}
    with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as bag:
        known = sorted({connection.topic for connection in bag.connections})
        for topic in per_topic:
            if topic not in known:
                raise missing_field(path, topic, known)
        chosen = [connection for connection in bag.connections if connection.topic in per_topic]
        for connection, received, raw in bag.messages(connections=chosen):
            message = bag.deserialize(raw, connection.msgtype)
            times[connection.topic].append(NANOSECOND * _stamp(message, received))
            for name in per_topic[connection.topic]:
                taken[name].append(_numbers(path, name, message))
    for topic, stamps in times.items():
        if not stamps:
            raise LogError(f"{path}: topic {topic!r} has no message")
    return {name: (np.array(times[name.partition(".")[0]]), np.array(rows)) for name, rows in taken.items()}


def _stamp(message: Any, received: int) -> int:
    """Return the time of a message [ns]."""
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    told = 0 if stamp is None else stamp.sec * 10**9 + stamp.nanosec
    return told or received


def _numbers(path: Path, name: str, message: Any) -> list[float]:
    """Return the numbers of a field."""
    parsed = re.fullmatch(r"([\w.]+)(?:\[(\d+)\])?", name.partition(".")[2], re.ASCII)
    if parsed is None:
        raise LogError(f"{path}: field {name!r} is no path in a message, as pose.position or data[0]")
    inner, element = parsed.groups()
    try:
        value = attrgetter(inner)(message)
        if element is not None:
            value = value[int(element)]
    except (AttributeError, IndexError, TypeError) as error:
        raise missing_field(path, name, [f"{name.partition('.')[0]}.{each}" for each in _fields(message)]) from error
    if isinstance(value, (float, int)):
        return [float(value)]
    if isinstance(value, (np.ndarray, np.number)):
        return [float(x) for x in np.ravel(value)]
    parts = [getattr(value, axis) for axis in ORDER if hasattr(value, axis)]
    if not parts or not all(isinstance(x, (float, int)) for x in parts):
        raise LogError(f"{path}: field {name!r} holds no numbers; it has {', '.join(_fields(value)) or 'none'}")
    return [float(x) for x in parts]


def _fields(message: Any) -> list[str]:
    """Return the names in a message."""
    return [name for name in getattr(message, "__dataclass_fields__", {}) if not name.startswith("__")]
