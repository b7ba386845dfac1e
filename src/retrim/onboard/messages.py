"""Messages between the processes of a live flight, which are frozen values with conversions to and from bytes."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..errors import MessageError
from ..transport.bus import Bus
from ..transport.message import ArrayLike, describe, pack_arrays, unpack_arrays
from .note_fields import plain, read_fields

STATE = 15  # p, R by rows, v
STOPPED = "stopped without measurements"
"""First words of the reason for the end of a flight if the motors were stopped in the air."""


class StaleError(MessageError):
    """An intact message is not newer than the last message that was read."""


@dataclass(frozen=True)
class Stamp:
    """Tick and send time of a sample; an answer needs both, even if the sample's state is not finite."""

    tick: int
    """Ticks since the start of the flight."""
    send_time: float
    """Send time on the machine's monotonic clock [s]."""

    @classmethod
    def unpack(cls, data: bytes) -> "Stamp":
        """Read the stamp of a sample and ignore the other numbers of the sample, which may not be finite.

        Raises:
            MessageError: The bytes are not a sample, or the stamp is not finite.
        """
        row = _numbers(data)
        if not np.isfinite(row[[0, 2]]).all():
            raise MessageError("sample: its stamp is not finite")
        return cls(int(row[0]), float(row[2]))


@dataclass(frozen=True)
class Sample:
    """Measurement of the plant at the end of a tick."""

    tick: int
    """Ticks since the start of the flight."""
    t: float
    """Time on the plant's clock [s]."""
    send_time: float
    """Send time on the machine's monotonic clock [s]."""
    age: float
    """Time since the state was valid [s]."""
    state: np.ndarray
    """Measured state: p [m], R by rows and v [m/s] in the world frame."""
    truth: np.ndarray
    """Like ``state``, but the true state if the plant provides it. Scores use the true state; pilots never use it."""
    accepted: np.ndarray
    """Command [c, omega] that the plant accepted for the past tick; with a command delay, the command acts later."""

    def pack(self) -> bytes:
        """Return the bytes; the inverse of :meth:`unpack`."""
        row = np.concatenate([[self.tick, self.t, self.send_time, self.age], self.state, self.truth, self.accepted])
        # as bits, so that the checksum also covers the stamp of a sample whose state is not finite
        return pack_arrays({"row": row.view(np.int64)}, kind="sample", about={})

    @classmethod
    def unpack(cls, data: bytes) -> "Sample":
        """Read a sample.

        Raises:
            MessageError: The bytes are not a sample, or a number is not finite.
        """
        row = _numbers(data)
        if not (finite := np.isfinite(row)).all():
            raise MessageError(f"sample: {row.size - np.count_nonzero(finite)} numbers are not finite")
        state, truth, accepted_u = row[4 : 4 + STATE], row[4 + STATE : 4 + 2 * STATE], row[4 + 2 * STATE :]
        return cls(int(row[0]), float(row[1]), float(row[2]), float(row[3]), state, truth, accepted_u)


def _numbers(data: bytes) -> np.ndarray:
    """Return the numbers of an intact sample, which may not be finite."""
    expected = {"row": np.empty(8 + 2 * STATE, dtype=np.int64)}
    return unpack_arrays(data, expected, kind="sample", source="sample")["row"].view(float)


@dataclass(frozen=True)
class Setpoint:
    """A command to the plant."""

    tick: int
    """Tick of the sample that this command answers."""
    send_time: float
    """Send time on the monotonic clock [s]."""
    u: np.ndarray
    """Command: c [m/s^2], omega [rad/s]."""
    target: np.ndarray
    """Current target position in the world frame [m]; a controller that takes over holds the vehicle there."""
    is_final: bool = False
    """Whether the vehicle has landed or its motors must stop; the plant then stops."""
    blind: bool = False
    """Whether the motors must stop in the air because the state of the vehicle is unknown."""

    def pack(self) -> bytes:
        """Return the bytes; the inverse of :meth:`unpack`."""
        row = np.concatenate([[self.tick, self.send_time, self.is_final], self.u, self.target, [self.blind]])
        return pack_arrays({"row": row}, kind="setpoint", about={})

    @classmethod
    def unpack(cls, data: bytes) -> "Setpoint":
        """Read a command.

        Raises:
            MessageError: The bytes are not a command, or a number is not finite.
        """
        row = unpack_arrays(data, {"row": np.empty(11)}, kind="setpoint", source="setpoint")["row"]
        return cls(int(row[0]), float(row[1]), row[3:7], row[7:10], bool(row[2]), bool(row[10]))

    def ending(self, height: float) -> str:
        """Return the reason for the end of a flight with this as its last command.

        Args:
            height: Last known height [m].
        """
        return f"{STOPPED} at {height:.2f} m" if self.blind else "landed"


COLUMNS = (
    *("tick", "t", "age"),
    *(f"x{i}" for i in range(STATE)),
    *(f"true{i}" for i in range(STATE)),
    *("c", "omega0", "omega1", "omega2"),
    *("lateness", "step", "idle", "state_age", "policy_age", "phase", "mode"),
)
"""Columns of a row in reports and in the log; each row describes one tick. ``idle`` is the duration of the work that is
not urgent. ``phase`` is the time along the reference. Times are in seconds."""
MEASURED, TRUE = slice(3, 3 + STATE), slice(3 + STATE, 3 + 2 * STATE)
COMMAND = slice(3 + 2 * STATE, 7 + 2 * STATE)
PHASE = COLUMNS.index("phase")
ACCOUNTS = {name: COLUMNS.index(name) for name in ("lateness", "step", "idle", "state_age", "policy_age")}
MOST_TICKS = 10_000  # largest number of ticks in a report


@dataclass(frozen=True)
class FlightRows:
    """The last ticks of a flight, oldest first; each row contains the command that followed its measurement."""

    rows: np.ndarray
    """One row per tick, with the columns in ``COLUMNS``."""

    def pack(self) -> bytes:
        """Return the bytes; the inverse of :meth:`unpack`."""
        return pack_arrays({"rows": self.rows}, kind="flight", about={"ticks": str(len(self.rows))})

    @classmethod
    def unpack(cls, data: bytes) -> "FlightRows":
        """Read the rows.

        Raises:
            MessageError: The bytes are not flight rows.
        """
        ticks = describe(data, kind="flight", source="flight").get("ticks", "")
        if not ticks.isdecimal() or len(ticks) > 6 or int(ticks) > MOST_TICKS:
            raise MessageError(f"flight: {ticks[:20]!r} ticks")
        expected = {"rows": np.empty((int(ticks), len(COLUMNS)))}
        return cls(unpack_arrays(data, expected, kind="flight", source="flight")["rows"])


@dataclass(frozen=True)
class Parameters:
    """New parameters of one part (``half``) of a controller, such as ``policy`` or ``residual``."""

    half: str
    version: int
    """Increasing number; a message whose version is not newer than the last one is stale."""
    base: str
    """Hash of the controller for which the parameters are intended; the receiver refuses those for a different one."""
    computed_from: float
    """Flight time of the newest measurement in the training data [s]."""
    arrays: Mapping[str, Any] = field(repr=False)
    parent: int = 0
    """Version from which training started; 0 for the version at take-off."""

    def pack(self) -> bytes:
        """Return the bytes; the inverse of :meth:`unpack`."""
        about = {"version": str(self.version), "base": self.base, "computed_from": repr(self.computed_from)}
        about["parent"] = str(self.parent)
        return pack_arrays(self.arrays, kind=f"parameters of {self.half}", about=about)

    @classmethod
    def unpack(
        cls, data: bytes, expected: Mapping[str, ArrayLike], *, half: str, base: str, after: int
    ) -> "Parameters":
        """Read parameters.

        Args:
            data: Bytes of a message.
            expected: Shape and type of each array.
            half: Expected part of the controller.
            base: Expected hash of the controller.
            after: Newest version read so far.

        Raises:
            MessageError: The parameters are truncated, damaged, for a different controller or not finite.
            StaleError: The parameters are not newer than ``after``.
        """
        kind = f"parameters of {half}"
        header = describe(data, kind=kind, source=half)
        if header.get("base") != base:
            raise MessageError(f"{half}: parameters for a different controller, {header.get('base', 'unnamed')!r}")
        version, data_text = header.get("version", ""), header.get("computed_from", "")
        try:
            number, data_time, parent = int(version[:20]), float(data_text[:40]), int(header.get("parent", "")[:20])
        except ValueError as error:
            raise MessageError(f"{half}: version {version[:20]!r}, computed from {data_text[:40]!r}") from error
        arrays = unpack_arrays(data, expected, kind=kind, source=half)
        if number <= after or not np.isfinite(data_time):
            raise StaleError(f"{half}: version {number} is stale, {after} was taken")
        return cls(half, number, base, data_time, arrays, parent)


def pack_note(kind: str, **fields: Any) -> bytes:
    """Return the bytes of a small message of plain values, such as an order; the inverse of :func:`unpack_note`."""
    return pack_arrays({}, kind=kind, about={"fields": json.dumps(fields)})


def unpack_note(data: bytes, kind: str) -> dict[str, Any]:
    """Read a small message.

    Raises:
        MessageError: The bytes are not such a message, the kind differs, or a field has the wrong type or range.
    """
    header = describe(data, kind=kind, source=kind)
    unpack_arrays(data, {}, kind=kind, source=kind)
    try:
        fields = json.loads(header["fields"])
    except (KeyError, ValueError, RecursionError) as error:
        raise MessageError(f"{kind}: no fields ({plain(str(error))})") from error
    return read_fields(kind, fields)


def last_note(bus: Bus, topic: str, kind: str | None = None) -> dict[str, Any]:
    """Return the fields of the last small message of a topic; empty if there is no message or the message is damaged.

    Args:
        bus: Bus of the flight.
        topic: Name of the topic.
        kind: Expected kind of the message; by default the name of the topic.
    """
    message = bus.latest(topic)
    try:
        return {} if message is None else unpack_note(message.data, kind or topic)
    except MessageError:
        return {}


def last_send_time(bus: Bus, topic: str) -> float:
    """Return when a topic's newest command was sent [s, monotonic clock]; minus infinity if there is no valid command.

    Args:
        bus: Bus of the flight.
        topic: ``setpoint`` or ``fallback``.
    """
    message = bus.latest(topic)
    try:
        return float("-inf") if message is None else Setpoint.unpack(message.data).send_time
    except MessageError:
        return float("-inf")


def ticks_of(bus: Bus) -> int:
    """Return the number of ticks that the plant has sent so far.

    Args:
        bus: Bus of the flight.
    """
    message = bus.latest("sample")
    try:
        return 0 if message is None else Stamp.unpack(message.data).tick + 1
    except MessageError:
        return 0


def last_height(bus: Bus) -> float:
    """Return the last height that the plant has reported [m]; NaN if there is no valid report.

    Args:
        bus: Bus of the flight.
    """
    message = bus.latest("sample")
    try:
        return float("nan") if message is None else float(Sample.unpack(message.data).truth[2])
    except MessageError:
        return float("nan")
