"""Decodes the numbers in frames of a Blackbox log; each function returns values and the offset behind them.

The codes are those of the published format: variable-length integers (seven bits a byte, low bits first), and groups of
three, four or eight small numbers behind a tag byte. An offset beyond the data raises ``IndexError``.
"""

from collections.abc import Callable

WORD = 0xFFFFFFFF
Decode = Callable[[bytes, int, int], tuple[tuple[int, ...], int]]
"""Maps data, an offset and a number of fields to their values and the next offset."""


class DamagedFrameError(Exception):
    """Bytes are not a frame."""


def read_unsigned(data: bytes, at: int) -> tuple[int, int]:
    """Return a variable-length unsigned integer of at most 32 bits."""
    byte = data[at]
    at += 1
    if byte < 128:
        return byte, at
    value, shift = byte & 127, 7
    while True:
        byte = data[at]
        at += 1
        value |= (byte & 127) << shift
        if byte < 128:
            return value & WORD, at
        shift += 7
        if shift > 28:
            raise DamagedFrameError


def read_signed(data: bytes, at: int) -> tuple[int, int]:
    """Return a variable-length signed integer (zigzag)."""
    value, at = read_unsigned(data, at)
    return (value >> 1) ^ -(value & 1), at


def _one_unsigned(data: bytes, at: int, count: int) -> tuple[tuple[int, ...], int]:
    value, at = read_unsigned(data, at)
    return (value,), at


def _one_signed(data: bytes, at: int, count: int) -> tuple[tuple[int, ...], int]:
    value, at = read_signed(data, at)
    return (value,), at


def _negative_14(data: bytes, at: int, count: int) -> tuple[tuple[int, ...], int]:
    value, at = read_unsigned(data, at)
    return (-_extend(value & 0x3FFF, 14),), at


def _nothing(data: bytes, at: int, count: int) -> tuple[tuple[int, ...], int]:
    return (0,), at


def _eight(data: bytes, at: int, count: int) -> tuple[tuple[int, ...], int]:
    """Return up to eight numbers; a bit of the tag marks each number that is not zero."""
    if count == 1:
        return _one_signed(data, at, count)
    tag, values = data[at], []
    at += 1
    for k in range(count):
        value = 0
        if tag >> k & 1:
            value, at = read_signed(data, at)
        values.append(value)
    return tuple(values), at


def _three(data: bytes, at: int, count: int) -> tuple[tuple[int, ...], int]:
    """Return three numbers of 2, 4 or 6 bits, or of whole bytes."""
    tag = data[at]
    size = tag >> 6
    if size == 0:
        return tuple(_extend(tag >> shift & 3, 2) for shift in (4, 2, 0)), at + 1
    if size == 1:
        low = data[at + 1]
        return (_extend(tag & 15, 4), _extend(low >> 4, 4), _extend(low & 15, 4)), at + 2
    if size == 2:
        return tuple(_extend(data[at + k] & 63, 6) for k in range(3)), at + 3
    return _whole_bytes(data, at)


def _whole_bytes(data: bytes, at: int) -> tuple[tuple[int, ...], int]:
    tag, values = data[at], []
    at += 1
    for shift in (0, 2, 4):
        size = (tag >> shift & 3) + 1
        _ = data[at + size - 1]
        values.append(int.from_bytes(data[at : at + size], "little", signed=True))
        at += size
    return tuple(values), at


def _four(data: bytes, at: int, count: int) -> tuple[tuple[int, ...], int]:
    """Return four numbers of 0, 4, 8 or 16 bits, without gaps between their half bytes."""
    tag, values = data[at], []
    half = 2 * (at + 1)  # offset in half bytes
    for shift in (0, 2, 4, 6):
        size = (0, 1, 2, 4)[tag >> shift & 3]
        value = 0
        for _ in range(size):
            byte = data[half >> 1]
            value = value << 4 | (byte & 15 if half & 1 else byte >> 4)
            half += 1
        values.append(_extend(value, 4 * size) if size else 0)
    return tuple(values), (half + 1) >> 1


def _extend(value: int, bits: int) -> int:
    """Return a number with the sign of its highest bit."""
    return value - (1 << bits) if value >> (bits - 1) & 1 else value


DECODERS: dict[int, tuple[Decode, int]] = {
    0: (_one_signed, 1), 1: (_one_unsigned, 1), 3: (_negative_14, 1), 6: (_eight, 8), 7: (_three, 3), 8: (_four, 4),
    9: (_nothing, 1),
}  # fmt: skip
"""Function of each encoding, and the largest number of fields that it decodes at once."""


def decoding_plan(encodings: tuple[int, ...]) -> list[tuple[Decode, int]]:
    """Return the functions that decode a frame, each with its number of fields.

    Raises:
        DamagedFrameError: A group has too few fields.
    """
    plan, k = list[tuple[Decode, int]](), 0
    while k < len(encodings):
        decode, most = DECODERS[encodings[k]]
        count = 1
        while count < most and k + count < len(encodings) and encodings[k + count] == encodings[k]:
            count += 1
        if most in (3, 4) and count != most:
            raise DamagedFrameError
        plan.append((decode, count))
        k += count
    return plan
