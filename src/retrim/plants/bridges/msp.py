"""MSP, the serial protocol of Betaflight: packets, and the messages that a companion computer needs.

Facts are those of the protocol's version 1 and of Betaflight 4.3 to 4.6.
"""

import struct
from collections.abc import Iterator
from typing import NamedTuple

from ...errors import MessageError

API_VERSION, FC_VARIANT, FC_VERSION = 1, 2, 3
MODE_RANGES, RX_CONFIG, RX_MAP, ADVANCED_CONFIG = 34, 44, 64, 90
MOTOR, RC, RC_TUNING, BOX_IDS, RC_DEADBAND, STATUS_EX, SET_RAW_RC = 104, 105, 111, 119, 125, 150, 200
ARM, ANGLE, HORIZON, OVERRIDE = 0, 1, 2, 50  # permanent numbers of modes
LONGEST = 255  # bytes of a payload
REQUEST, ANSWER, REFUSAL = b"<", b">", b"!"
ACTUAL_RATES = 3  # number of the rate curve
STEP_FROM, STEP = 900, 25  # [us]: start and unit of a mode's range


class Packet(NamedTuple):
    """A message from the board."""

    code: int
    payload: bytes
    refused: bool
    """Whether the board does not know the request, or refuses it."""


def encode(code: int, payload: bytes = b"", kind: bytes = REQUEST) -> bytes:
    """Return a packet; the inverse of :class:`Parser`.

    Args:
        code: Number of the message, 0 to 255.
        payload: At most 255 bytes.
        kind: Direction: ``<`` to the board, ``>`` from it, ``!`` for a refusal.
    """
    body = bytes([len(payload), code]) + payload
    return b"$M" + kind + body + bytes([_checksum(body)])


class Parser:
    """Finds packets in a stream of bytes, which may contain others and may be damaged."""

    def __init__(self) -> None:
        self._rest = b""
        self.damaged = 0
        """Number of packets with a wrong checksum."""

    def feed(self, data: bytes) -> Iterator[Packet]:
        """Yield the packets that are complete with new bytes."""
        self._rest += data
        while (start := self._rest.find(b"$M")) >= 0:
            self._rest = self._rest[start:]
            if len(self._rest) < 6:
                return
            kind, size = self._rest[2:3], self._rest[3]
            if kind not in (ANSWER, REFUSAL):
                self._rest = self._rest[2:]
                continue
            if len(self._rest) < 6 + size:
                return
            body, check = self._rest[3 : 5 + size], self._rest[5 + size]
            if _checksum(body) != check:
                self.damaged += 1
                self._rest = self._rest[2:]
                continue
            self._rest = self._rest[6 + size :]
            yield Packet(body[1], body[2:], kind == REFUSAL)
        self._rest = self._rest[-1:]  # it may be the first half of a start


def _checksum(body: bytes) -> int:
    result = 0
    for byte in body:
        result ^= byte
    return result


class Status(NamedTuple):
    """State of the board."""

    modes: frozenset[int]
    """Permanent numbers of the active modes."""

    @classmethod
    def of(cls, payload: bytes, boxes: tuple[int, ...]) -> "Status":
        """Read an answer to ``STATUS_EX``.

        Args:
            payload: The answer.
            boxes: Permanent numbers of the modes, in the order of the answer to ``BOX_IDS``.
        """
        flags = int.from_bytes(_part(payload, 6, 4), "little")
        more = _part(payload, 15, 1)[0] & 0x0F
        flags |= int.from_bytes(_part(payload, 16, more), "little") << 32
        _part(payload, 17 + more, 4)  # a complete answer ends with the reasons against arming
        return cls(frozenset(number for bit, number in enumerate(boxes) if flags >> bit & 1))


class ModeRange(NamedTuple):
    """The range of an auxiliary channel in which a mode is active."""

    mode: int
    channel: int
    """Number of the receiver channel, from 0; the sticks are 0 to 3."""
    low: int
    """[us]"""
    high: int
    """[us]"""


def mode_ranges(payload: bytes) -> list[ModeRange]:
    """Read an answer to ``MODE_RANGES``; unused ranges are left out."""
    rows = [payload[i : i + 4] for i in range(0, len(payload) - 3, 4)]
    return [
        ModeRange(mode, 4 + aux, STEP_FROM + STEP * low, STEP_FROM + STEP * high)
        for mode, aux, low, high in rows
        if low < high
    ]


def numbers(payload: bytes) -> list[int]:
    """Read unsigned 16-bit numbers, as in answers to ``RC`` and ``MOTOR``."""
    return [each for (each,) in struct.iter_unpack("<H", payload[: len(payload) // 2 * 2])]


def sticks_payload(channels: list[int]) -> bytes:
    """Return the payload of ``SET_RAW_RC`` [us]."""
    return struct.pack(f"<{len(channels)}H", *channels)


def _part(payload: bytes, start: int, size: int) -> bytes:
    if len(payload) < start + size:
        raise MessageError(f"an MSP answer has {len(payload)} bytes; at least {start + size} are needed")
    return payload[start : start + size]


def byte_at(payload: bytes, place: int) -> int:
    """Return one byte of an answer.

    Raises:
        MessageError: The answer is too short.
    """
    return _part(payload, place, 1)[0]


def word_at(payload: bytes, place: int) -> int:
    """Return an unsigned 16-bit number in an answer.

    Raises:
        MessageError: The answer is too short.
    """
    return int.from_bytes(_part(payload, place, 2), "little")
