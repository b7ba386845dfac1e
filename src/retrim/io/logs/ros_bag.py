"""Reads ROS 1 and ROS 2 bags, and MCAP files with ROS messages. Needs the extra ``logs``.

A field is a topic and a path in its messages, for example ``/odom.pose.pose.position``. Vectors and quaternions are
read as a whole; ``[0]`` selects an array element. ``*`` in a topic matches any characters.
"""

import re
from collections.abc import Collection, Mapping, Sequence
from fnmatch import filter as fitting
from importlib.util import find_spec
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ...errors import LogError
from .message_times import on_one_time, stamp_of
from .series import Clock, Series, find_fields, missing_field, sign_of

NANOSECOND = 1e-9
ORDER = ("x", "y", "z", "w")


class Place(NamedTuple):
    """Location of a field."""

    topic: str
    inner: str


def read_bag(
    path: Path, request: Mapping[str, Sequence[str]], time: Clock | None, optional: Collection[str] = ()
) -> tuple[dict[str, Series], list[str]]:
    """Read topics from a bag; see :class:`~retrim.io.logs.series.LogReader`.

    Times come from the map's time field, the header or the stamps of PX4 messages, and otherwise from the recording.
    """
    if find_spec("rosbags") is None:
        raise LogError(f"{path}: a bag needs rosbags: pip install rosbags")
    try:
        return _read(path, request, time, optional)
    except LogError:
        raise
    except Exception as error:  # the parsers raise various errors for bytes that are not a bag
        hint = "; `mcap recover` repairs a file whose recorder was killed" if path.suffix == ".mcap" else ""
        raise LogError(f"{path}: cannot be read as a bag ({type(error).__name__}: {str(error)[:200]}){hint}") from error


def _read(
    path: Path, request: Mapping[str, Sequence[str]], time: Clock | None, optional: Collection[str]
) -> tuple[dict[str, Series], list[str]]:
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as bag:
        places = _places(path, request, sorted({connection.topic for connection in bag.connections}), optional)
        values: dict[Place, list[list[float]]] = {place: [] for result in places.values() for place in result}
        stamps: dict[str, list[tuple[float, float]]] = {place.topic: [] for place in values}
        connections = [connection for connection in bag.connections if connection.topic in stamps]
        for connection, arrival, raw in bag.messages(connections=connections):
            topic, message = connection.topic, bag.deserialize(raw, connection.msgtype)
            if not stamps[topic]:
                _check_fields(path, topic, message, places, values, optional)
            stamps[topic].append((stamp_of(message, time), NANOSECOND * arrival))
            for place in values:
                if place.topic == topic:
                    values[place].append(_numbers(path, place, message))
    for what in [what for what, result in places.items() if not stamps[result[0].topic]]:
        if what not in optional:
            raise LogError(f"{path}: topic {places[what][0].topic!r} has no message")
        del places[what]
    times, notes = on_one_time({topic: np.array(both) for topic, both in stamps.items() if both})
    result = dict[str, Series]()
    for what, fields in places.items():
        parts = [sign_of(name) * np.array(values[place]) for name, place in zip(request[what], fields, strict=True)]
        result[what] = Series(times[fields[0].topic], np.concatenate(parts, axis=1))
    return result, notes


def _places(
    path: Path, request: Mapping[str, Sequence[str]], topics: Sequence[str], optional: Collection[str]
) -> dict[str, list[Place]]:
    """Return the locations of each quantity's fields."""
    places = dict[str, list[Place]]()
    for what, parts in find_fields(request, lambda each: _place(path, each, topics), optional):
        if len({place.topic for place in parts}) > 1:
            raise LogError(f"{path}: the fields of {what} come from several topics: {', '.join(request[what])}")
        places[what] = parts
    return places


def _place(path: Path, name: str, topics: Sequence[str]) -> Place:
    topic, _, inner = name.partition(".")
    if not inner:
        raise LogError(f"{path}: field {name!r} must be a topic and a path, as /odom.pose.pose.position")
    fit = [topic] if topic in topics else fitting(topics, topic)
    if not fit:
        raise missing_field(path, topic, topics)
    if len(fit) > 1:
        raise LogError(f"{path}: {topic!r} matches several topics: {', '.join(fit[:5])}; name one in the map")
    return Place(fit[0], inner)


def _check_fields(
    path: Path,
    topic: str,
    message: Any,
    places: dict[str, list[Place]],
    values: dict[Place, list[list[float]]],
    optional: Collection[str],
) -> None:
    """Remove the optional quantities that a topic's messages do not contain."""
    for what in [what for what, result in places.items() if what in optional and result[0].topic == topic]:
        try:
            for place in places[what]:
                _numbers(path, place, message)
        except LogError:
            del places[what]
    needed_places = {place for result in places.values() for place in result}
    for place in [place for place in values if place not in needed_places]:
        del values[place]


def _numbers(path: Path, place: Place, message: Any) -> list[float]:
    """Return the numbers in a field."""
    name = f"{place.topic}.{place.inner}"
    match = re.fullmatch(r"([\w.]+)(?:\[(\d+)\])?", place.inner, re.ASCII)
    if match is None:
        raise LogError(f"{path}: field {name!r} is not a path in a message, as pose.position or data[0]")
    inner, element = match.groups()
    try:
        value = attrgetter(inner)(message)
        if element is not None:
            value = value[int(element)]
    except (AttributeError, IndexError, TypeError) as error:
        raise missing_field(path, name, [f"{place.topic}.{each}" for each in _fields(message)]) from error
    if isinstance(value, (float, int)):
        return [float(value)]
    if isinstance(value, (np.ndarray, np.generic)):
        return [float(x) for x in np.ravel(value)]
    parts = [getattr(value, axis) for axis in ORDER if hasattr(value, axis)]
    if not parts or not all(isinstance(x, (float, int)) for x in parts):
        raise LogError(f"{path}: field {name!r} holds no numbers; it has {', '.join(_fields(value)) or 'none'}")
    return [float(x) for x in parts]


def _fields(message: Any) -> list[str]:
    """Return the names of a message's fields."""
    return [name for name in getattr(message, "__dataclass_fields__", {}) if not name.startswith("__")]
