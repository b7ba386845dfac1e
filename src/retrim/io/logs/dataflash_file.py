"""Reads dataflash logs of ArduPilot (``.bin``), without any other package.

A field is written ``message.field``, for example ``RATE.RDes``; ``IMU#1.GyrX`` selects the second instance of a
message. The file describes its own messages; numbers are in the units of ArduPilot.
"""

import re
from array import array
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ...errors import LogError
from .flights import Span, choose_flight
from .series import Clock, Series, find_fields, missing_field, sign_of

MARK = b"\xa3\x95"
FORMAT, FORMAT_LENGTH = 128, 89  # type and length of the message that describes other messages
MICROSECOND = 1e-6
TIME = "TimeUS"
INSTANCES = ("I", "C", "Instance", "Core")  # fields that count the instances of a message
RESTART_US = 1_000_000  # step back of the time that means a restart [us]
NEIGHBOURS = 5  # number of messages before and after a time that show whether it is damaged
ARMED, DISARMED = 10, 11  # events
MOST_MESSAGES = 50_000_000
CODES: Mapping[str, tuple[str, float]] = {
    "b": ("i1", 1.0), "B": ("u1", 1.0), "M": ("u1", 1.0), "h": ("<i2", 1.0), "H": ("<u2", 1.0), "i": ("<i4", 1.0),
    "I": ("<u4", 1.0), "q": ("<i8", 1.0), "Q": ("<u8", 1.0), "f": ("<f4", 1.0), "d": ("<f8", 1.0), "g": ("<f2", 1.0),
    "c": ("<i2", 0.01), "C": ("<u2", 0.01), "e": ("<i4", 0.01), "E": ("<u4", 0.01), "L": ("<i4", 1e-7),
    "n": ("S4", 0.0), "N": ("S16", 0.0), "Z": ("S64", 0.0), "a": ("64u1", 0.0),
}  # fmt: skip
"""Type of each code in a format, and the unit of its numbers; 0 for text and arrays."""


class Message(NamedTuple):
    """Layout of one kind of message."""

    name: str
    dtype: np.dtype
    """Fields behind the three bytes of the head."""
    units: Mapping[str, float]


@dataclass(frozen=True)
class Contents:
    """Layouts of a file's messages, and the offsets at which they begin."""

    layouts: Mapping[str, Message]
    offsets: Mapping[str, np.ndarray]
    skipped: int
    """Bytes that belong to no message."""


@np.errstate(invalid="ignore")  # a damaged number may be a signalling NaN
def read_dataflash(
    path: Path,
    request: Mapping[str, Sequence[str]],
    time: Clock | None,
    optional: Collection[str] = (),
    flight: int | None = None,
) -> tuple[dict[str, Series], list[str]]:
    """Read messages of one flight; see :class:`~retrim.io.logs.series.LogReader`.

    Args:
        path: The file.
        request: Fields of each quantity.
        time: Not used; messages have their own times.
        optional: Quantities that may be missing.
        flight: Number of the flight in the file, from 1. A flight lasts from arming to disarming.
    """
    raw = path.read_bytes()
    data, contents = np.frombuffer(raw, np.uint8), _scan(path, raw)
    names = {name: message for name, message in contents.layouts.items() if len(contents.offsets[name])}
    fields_of = dict(find_fields(request, lambda each: _find(path, each, names), optional))
    spans = _flights(data, contents)
    k, notes = choose_flight(path, [Span(*(MICROSECOND * t for t in each[2:])) for each in spans], flight)
    first, last = spans[k][:2]
    if contents.skipped:
        notes.append(f"{contents.skipped} bytes of the file belong to no message, and are left out")
    result = dict[str, Series]()
    for what, parts in fields_of.items():
        if len({part[:2] for part in parts}) > 1:
            raise LogError(f"{path}: the fields of {what} come from several messages: {', '.join(request[what])}")
        name, instance, _ = parts[0]
        message, at = names[name], contents.offsets[name]
        rows = _rows(data, message, at[(at >= first) & (at < last)])
        counter = next((each for each in INSTANCES if each in message.units and message.dtype[each].kind in "iu"), None)
        if counter is not None and len(rows):
            rows = rows[rows[counter] == (instance if instance >= 0 else rows[counter].min())]
        if not len(rows):
            if what in optional:
                continue
            raise LogError(f"{path}: the flight has no message {name}")
        columns = [
            sign_of(spelling) * message.units[part[2]] * rows[part[2]].astype(float)
            for spelling, part in zip(request[what], parts, strict=True)
        ]
        result[what] = Series(MICROSECOND * rows[TIME].astype(float), np.stack(columns, axis=1))
    return result, notes


def _scan(path: Path, raw: bytes) -> Contents:
    """Return where the messages of a file are."""
    layouts, at, total, skipped = dict[str, Message](), 0, 0, 0
    kinds, lengths, places = dict[int, str](), {FORMAT: FORMAT_LENGTH}, dict[str, "array[int]"]()
    while at + 3 <= len(raw):
        kind = raw[at + 2]
        length = lengths.get(kind, 0)
        if raw[at : at + 2] != MARK or not length or at + length > len(raw):
            after = raw.find(MARK, at + 1)
            skipped += (after if after >= 0 else len(raw)) - at
            at = after if after >= 0 else len(raw)
            continue
        if kind == FORMAT:
            described = _describe(raw[at + 3 : at + FORMAT_LENGTH])
            if described is not None and layouts.get(described[2].name, described[2]) == described[2]:
                code, size, message = described
                kinds[code], lengths[code] = message.name, size
                layouts[message.name] = message
                places.setdefault(message.name, array("q"))
        elif kind in kinds:
            places[kinds[kind]].append(at)
        at, total = at + length, total + 1
        if total > MOST_MESSAGES:
            raise LogError(f"{path}: more than {MOST_MESSAGES} messages; cut out a part of the flight")
    if not layouts:
        raise LogError(f"{path}: it is not a dataflash log of ArduPilot: no message describes the others")
    return Contents(layouts, {name: np.array(each, np.int64) for name, each in places.items()}, skipped)


def _describe(body: bytes) -> tuple[int, int, Message] | None:
    """Return the type, the length and the layout in a format message.

    None if the message is damaged, if it has no known layout, or if its time is not a number.
    """
    code, length = body[0], body[1]
    name, codes, labels = (body[a:b].split(b"\0")[0].decode("latin-1") for a, b in ((2, 6), (6, 22), (22, 86)))
    fields = labels.split(",") if labels else []
    if code == FORMAT or not re.fullmatch(r"[A-Za-z0-9_]{1,4}", name) or len(codes) != len(fields):
        return None
    if any(each not in CODES for each in codes) or len(set(fields)) != len(fields) or not all(fields):
        return None
    units = {each: CODES[c][1] for each, c in zip(fields, codes, strict=True)}
    if units.get(TIME) == 0.0:
        return None
    dtype = np.dtype([(each, CODES[c][0]) for each, c in zip(fields, codes, strict=True)])
    if dtype.itemsize + 3 != length:
        return None
    return code, length, Message(name, dtype, units)


def _rows(data: np.ndarray, message: Message, at: np.ndarray) -> np.ndarray:
    """Return the fields of messages at some offsets."""
    size = message.dtype.itemsize
    return np.ascontiguousarray(data[at[:, None] + 3 + np.arange(size)]).view(message.dtype).reshape(-1)


def _find(path: Path, name: str, messages: Mapping[str, Message]) -> tuple[str, int, str]:
    """Return the message of a field, the instance (-1 for the first) and the field's own name."""
    kind, _, label = name.partition(".")
    kind, _, number = kind.partition("#")
    if kind not in messages or TIME not in messages[kind].units:
        raise missing_field(path, kind, sorted(messages))
    if not messages[kind].units.get(label):
        raise missing_field(path, name, [f"{kind}.{each}" for each, unit in messages[kind].units.items() if unit])
    return kind, int(number) if number.isascii() and number.isdigit() else -1, label


def _flights(data: np.ndarray, contents: Contents) -> list[tuple[int, int, float, float]]:
    """Return the flights: first and last offset, and first and last time [us].

    A flight lasts from arming to disarming. A log without these events is one flight, or one for each start of the
    board, after which the time begins again.
    """
    result = list[tuple[int, int, float, float]]()
    for at, t in _boots(data, contents):
        begin: int | None = None
        spans = list[tuple[int, int]]()
        for offset, is_armed in _arming(data, contents, int(at[0]), int(at[-1])):
            if is_armed and begin is None:
                begin = offset
            elif not is_armed and begin is not None:
                spans.append((begin, offset))
                begin = None
        if begin is not None:
            spans.append((begin, int(at[-1]) + 1))
        for first, last in spans or [(int(at[0]), int(at[-1]) + 1)]:
            inside = (at >= first) & (at < last)
            if inside.any():
                result.append((first, last, float(t[inside].min()), float(t[inside].max())))
    return result


def _boots(data: np.ndarray, contents: Contents) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield the offsets and times of the messages after each start of the board."""
    parts = [
        (at, _rows(data, contents.layouts[name], at)[TIME].astype(float))
        for name, at in contents.offsets.items()
        if len(at) and TIME in contents.layouts[name].units
    ]
    if not parts:
        return
    order = np.argsort(np.concatenate([at for at, _ in parts]))
    at, t = (np.concatenate(each)[order] for each in zip(*parts, strict=True))
    damage = _mark_damage(t)
    at, t = at[~damage], t[~damage]
    starts = np.flatnonzero(np.diff(t) < -RESTART_US) + 1
    for first, last in zip([0, *starts], [*starts, len(t)], strict=True):
        yield at[first:last], t[first:last]


def _mark_damage(t: np.ndarray) -> np.ndarray:
    """Return a mask of the times that are later, or earlier, than those of the messages before and after them."""
    from scipy.ndimage import median_filter  # local, because it takes as long to import as all of retrim

    none = np.full(NEIGHBOURS, -np.inf)  # the first and the last time are damaged if they are too late
    medians = median_filter(np.concatenate([none, t, none]), NEIGHBOURS)
    reach = NEIGHBOURS // 2
    before, after = (medians[k : k + len(t)] for k in (NEIGHBOURS - reach - 1, NEIGHBOURS + reach + 1))
    too_late, too_early = t - RESTART_US, t + RESTART_US
    return np.asarray(((too_late > before) & (too_late > after)) | ((too_early < before) & (too_early < after)))


def _arming(data: np.ndarray, contents: Contents, first: int, last: int) -> list[tuple[int, bool]]:
    """Return the offsets between two others at which the vehicle is armed (true) or disarmed."""
    result = list[tuple[int, bool]]()
    for name, label, values in (("ARM", "ArmState", (1, 0)), ("EV", "Id", (ARMED, DISARMED))):
        message = contents.layouts.get(name)
        if result or message is None or label not in message.units:
            continue
        at = contents.offsets[name]
        at = at[(at >= first) & (at <= last)]
        states = _rows(data, message, at)[label].tolist()
        result = [(int(k), bool(s == values[0])) for k, s in zip(at, states, strict=True) if s in values]
    return result
