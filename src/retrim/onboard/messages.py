"""What the processes of a live flight tell each other: frozen values that turn into bytes and back."""

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
"""How the reason begins why a flight ended whose vehicle was dropped."""


class StaleError(MessageError):
    """A whole message that is not newer than what is known."""


@dataclass(frozen=True)
class Stamp:
    """What an answer to a sample needs to know of it, whether or not its state is finite."""

    tick: int
    """Ticks since the start of the flight."""
    sent: float
    """When it was sent, by the monotonic clock of the machine [s]."""

    @classmethod
    def unpack(cls, data: bytes) -> "Stamp":
        """Read the stamp of a sample, whose other numbers may be anything.

        Raises:
            MessageError: The bytes are no sample, or the stamp is not finite.
        """
        row = _numbers(data)
        if not np.isfinite(row[[0, 2]]).all():
            raise MessageError("sample: its stamp is not finite")
        return cls(int(row[0]), float(row[2]))


@dataclass(frozen=True)
class Sample:
    """What the plant measured at the end of a tick."""

    tick: int
    """Ticks since the start of the flight."""
    t: float
    """Time by the plant's clock [s]."""
    sent: float
    """When it was sent, by the monotonic clock of the machine [s]."""
    age: float
    """Time since the state was valid [s]."""
    state: np.ndarray
    """p [m], R by rows, v [m/s], world."""
    truth: np.ndarray
    """The same, true where the plant knows it; for scores, never for pilots."""
    accepted: np.ndarray
    """Command [c, omega] that was taken for the tick that has ended; a delay of the plant lets it act later."""

    def pack(self) -> bytes:
        """Return the bytes; the inverse of :meth:`unpack`."""
        row = np.concatenate([[self.tick, self.t, self.sent, self.age], self.state, self.truth, self.accepted])
        # as bits, so that the checksum proves the stamp of a sample whose state is not finite, too
        return pack_arrays({"row": row.view(np.int64)}, kind="sample", about={})

    @classmethod
    def unpack(cls, data: bytes) -> "Sample":
        """Read a sample.

        Raises:
            MessageError: The bytes are not one, or a number is not finite.
        """
        row = _numbers(data)
        if not (finite := np.isfinite(row)).all():
            raise MessageError(f"sample: {row.size - np.count_nonzero(finite)} numbers are not finite")
        state, truth, accepted = row[4 : 4 + STATE], row[4 + STATE : 4 + 2 * STATE], row[4 + 2 * STATE :]
        return cls(int(row[0]), float(row[1]), float(row[2]), float(row[3]), state, truth, accepted)


def _numbers(data: bytes) -> np.ndarray:
    """Return the numbers of a whole sample, which may not be finite."""
    expected = {"row": np.empty(8 + 2 * STATE, dtype=np.int64)}
    return unpack_arrays(data, expected, kind="sample", source="sample")["row"].view(float)


@dataclass(frozen=True)
class Setpoint:
    """A command on its way to the plant."""

    tick: int
    """Sample that it answers."""
    sent: float
    """Monotonic clock [s]."""
    u: np.ndarray
    """c [m/s^2], omega [rad/s]."""
    target: np.ndarray
    """Where the vehicle should be now, world [m]; who takes over holds it there."""
    landed: bool = False
    """The vehicle has landed, or shall fall: the plant stops."""
    blind: bool = False
    """It shall fall, since nobody knows its state."""

    def pack(self) -> bytes:
        """Return the bytes; the inverse of :meth:`unpack`."""
        row = np.concatenate([[self.tick, self.sent, self.landed], self.u, self.target, [self.blind]])
        return pack_arrays({"row": row}, kind="setpoint", about={})

    @classmethod
    def unpack(cls, data: bytes) -> "Setpoint":
        """Read a command.

        Raises:
            MessageError: The bytes are not one, or a number is not finite.
        """
        row = unpack_arrays(data, {"row": np.empty(11)}, kind="setpoint", source="setpoint")["row"]
        return cls(int(row[0]), float(row[1]), row[3:7], row[7:10], bool(row[2]), bool(row[10]))

    def ending(self, height: float) -> str:
        """Return why the flight is over, for its last command.

        Args:
            height: Last one that is known [m].
        """
        return f"{STOPPED} at {height:.2f} m" if self.blind else "landed"


COLUMNS = (
    *("tick", "t", "age"),
    *(f"x{i}" for i in range(STATE)),
    *(f"true{i}" for i in range(STATE)),
    *("c", "omega0", "omega1", "omega2"),
    *("lateness", "step", "idle", "state_age", "policy_age", "mode"),
)
"""Of a tick in a report and in the log: idle is how long the work took that is not urgent; times are in seconds."""
MEASURED, TRUE = slice(3, 3 + STATE), slice(3 + STATE, 3 + 2 * STATE)
COMMAND = slice(3 + 2 * STATE, 7 + 2 * STATE)
ACCOUNTS = {name: COLUMNS.index(name) for name in ("lateness", "step", "idle", "state_age", "policy_age")}
MOST_TICKS = 10_000  # in a report


@dataclass(frozen=True)
class FlightRows:
    """The last ticks of a flight, oldest first; each has the command that followed its measurement."""

    rows: np.ndarray
    """One row per tick, columns as in ``COLUMNS``."""

    def pack(self) -> bytes:
        """Return the bytes; the inverse of :meth:`unpack`."""
        return pack_arrays({"rows": self.rows}, kind="flight", about={"ticks": str(len(self.rows))})

    @classmethod
    def unpack(cls, data: bytes) -> "FlightRows":
        """Read rows.

        Raises:
            MessageError: The bytes are none.
        """
        ticks = describe(data, kind="flight", source="flight").get("ticks", "")
        if not ticks.isdecimal() or len(ticks) > 6 or int(ticks) > MOST_TICKS:
            raise MessageError(f"flight: {ticks[:20]!r} ticks")
        expected = {"rows": np.empty((int(ticks), len(COLUMNS)))}
        return cls(unpack_arrays(data, expected, kind="flight", source="flight")["rows"])


@dataclass(frozen=True)
class Parameters:
    """New parameters of one half of a controller: ``policy`` or ``residual``."""

    half: str
    version: int
    """It rises; what is not newer is stale."""
    base: str
    """Hash of what the receiver was started with: parameters for another controller are foreign."""
    computed_from: float
    """Flight time of the newest measurement that they were learnt from [s]."""
    arrays: Mapping[str, Any] = field(repr=False)
    parent: int = 0
    """Version that they were trained from; 0 for that of take-off."""

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
            half: Which half they should be for.
            base: Hash that they should name.
            after: Newest version that was looked at.

        Raises:
            MessageError: They are truncated, damaged, foreign or not finite.
            StaleError: They are not newer than ``after``.
        """
        kind = f"parameters of {half}"
        header = describe(data, kind=kind, source=half)
        if header.get("base") != base:
            raise MessageError(f"{half}: parameters for another controller, {header.get('base', 'unnamed')!r}")
        version, computed = header.get("version", ""), header.get("computed_from", "")
        try:
            number, learnt, parent = int(version[:20]), float(computed[:40]), int(header.get("parent", "")[:20])
        except ValueError as error:
            raise MessageError(f"{half}: version {version[:20]!r}, computed from {computed[:40]!r}") from error
        arrays = unpack_arrays(data, expected, kind=kind, source=half)
        if number <= after or not np.isfinite(learnt):
            raise StaleError(f"{half}: version {number} is stale, {after} was taken")
        return cls(half, number, base, learnt, arrays, parent)


def pack_note(kind: str, **fields: Any) -> bytes:
    """Return the bytes of a small message of plain values: an order, a report; the inverse of :func:`unpack_note`."""
    return pack_arrays({}, kind=kind, about={"fields": json.dumps(fields)})


def unpack_note(data: bytes, kind: str) -> dict[str, Any]:
    """Read a small message.

    Raises:
        MessageError: It is none, of another kind, or a field is not of its type or range.
    """
    header = describe(data, kind=kind, source=kind)
    unpack_arrays(data, {}, kind=kind, source=kind)
    try:
        fields = json.loads(header["fields"])
    except (KeyError, ValueError, RecursionError) as error:
        raise MessageError(f"{kind}: no fields ({plain(str(error))})") from error
    return read_fields(kind, fields)


def last_note(bus: Bus, topic: str, kind: str | None = None) -> dict[str, Any]:
    """Return the fields of the last small message of a topic; none if there is none, or if it is damaged.

    Args:
        bus: Where it was published.
        topic: Name.
        kind: What it should be; by default what the topic is called.
    """
    message = bus.latest(topic)
    try:
        return {} if message is None else unpack_note(message.data, kind or topic)
    except MessageError:
        return {}


def last_sent(bus: Bus, topic: str) -> float:
    """Return when the newest command of a topic was sent, monotonic clock [s]; minus infinity if there is none.

    Args:
        bus: Where it was published.
        topic: ``setpoint`` or ``fallback``.
    """
    message = bus.latest(topic)
    try:
        return float("-inf") if message is None else Setpoint.unpack(message.data).sent
    except MessageError:
        return float("-inf")


def ticks_of(bus: Bus) -> int:
    """Return how many ticks the plant has sent so far.

    Args:
        bus: Where it was published.
    """
    message = bus.latest("sample")
    try:
        return 0 if message is None else Stamp.unpack(message.data).tick + 1
    except MessageError:
        return 0


def last_height(bus: Bus) -> float:
    """Return the height that the plant said last [m]; NaN if it has said none.

    Args:
        bus: Where it was published.
    """
    message = bus.latest("sample")
    try:
        return float("nan") if message is None else float(Sample.unpack(message.data).truth[2])
    except MessageError:
        return float("nan")
