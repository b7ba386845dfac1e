"""Decodes the frames of one flight in a Blackbox log.

A main frame (I) holds numbers, and the frames after it (P) hold differences from predictions. A damaged frame is left
out, and so are the frames after it until the next I frame, because they build on it.
"""

from array import array
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from .blackbox_codes import DamagedFrameError, Decode, decoding_plan, read_signed, read_unsigned
from .blackbox_header import BlackboxHeader

FRAMES = frozenset(b"IPSGHE")
LATE_US, LATE_LOOPS = 10_000_000, 5_000  # largest steps of the time [us] and of the loop counter between frames
LAST = b"End of log\x00"
END = -1  # offset behind the end mark
CENTRE = 1500  # [us]
HALF, FULL_RANGE = 1 << 31, 1 << 32


@dataclass(frozen=True)
class Frames:
    """Decoded main frames."""

    columns: dict[str, np.ndarray]
    """Values of each field, (n,)."""
    damaged: int
    """Number of damaged frames."""
    complete: bool
    """Whether the log ends as a board ends it."""


class FrameDecoder:
    """Decodes frames from an offset on, with the memory that predictions need."""

    def __init__(self, data: bytes, header: BlackboxHeader, end: int) -> None:
        """Prepare the decoder of one flight.

        Args:
            data: Contents of the file.
            header: The flight's header.
            end: Offset at which the flight ends.

        Raises:
            DamagedFrameError: A group of fields in the header is not complete.
        """
        self._data, self._header, self._end = data, header, end
        self._plans = {kind: decoding_plan(layout.encodings) for kind, layout in header.layouts.items()}
        self._predictors = {kind: layout.predictors for kind, layout in header.layouts.items()}
        names = header.names
        self._first_motor = names.index("motor[0]") if "motor[0]" in names else 0
        self._min_throttle = int(header.numbers("minthrottle", (1150.0,))[0])
        self._min_motor = int(header.numbers("motorOutput", (float(self._min_throttle), 2000.0))[0])
        self._battery = int(header.numbers("vbatref", (4095.0,))[0])
        self._number, self._count = header.interval()
        self._one: tuple[int, ...] | None = None  # the last two main frames
        self._two: tuple[int, ...] | None = None
        self._last: tuple[int, int] | None = None  # loop counter and time of the last main frame

    def decode(self, fields: Sequence[str]) -> Frames:
        """Return the values of some fields in all frames."""
        places = [self._header.names.index(name) for name in fields]
        store = [array("q") for _ in places]
        data, at, damaged, complete = self._data, self._header.end, 0, False
        while at < self._end:
            kind = data[at]
            if kind not in FRAMES:
                damaged += self._one is not None
                self._forget()
                at += 1
                continue
            try:
                frame, after = self._frame(chr(kind), at + 1)
                if not self._ends_well(after):
                    raise DamagedFrameError
            except (DamagedFrameError, IndexError):
                damaged += self._one is not None
                self._forget()
                at += 1
                continue
            if after == END:
                complete = True
                break
            if frame is not None:
                self._two = self._one if kind == ord("P") else frame
                self._one, self._last = frame, (frame[0], frame[1])
                for column, place in zip(store, places, strict=True):
                    column.append(frame[place])
            at = after
        columns = {
            name: np.frombuffer(column, np.int64).astype(float) if column else np.zeros(0)
            for name, column in zip(fields, store, strict=True)
        }
        return Frames(columns, damaged, complete)

    def main_frames_after(self, at: int) -> Iterator[tuple[int, int]]:
        """Yield the loop counter and time of bytes that look like I frames, at or after an offset."""
        while (at := self._data.find(b"I", at, self._end)) >= 0:
            try:
                frame, after = self._frame("I", at + 1)
                if frame is not None and self._ends_well(after):
                    yield frame[0], frame[1]
            except (DamagedFrameError, IndexError):
                pass
            at += 1

    def _ends_well(self, after: int) -> bool:
        """Return whether the flight ends, or another frame begins, behind a frame."""
        return after in (self._end, END) or (after < self._end and self._data[after] in FRAMES)

    def _forget(self) -> None:
        self._one = self._two = None

    def _frame(self, kind: str, at: int) -> tuple[tuple[int, ...] | None, int]:
        """Return a main frame, or None for another one, and the offset behind it; ``END`` at the end of the log."""
        if kind == "E":
            return None, self._event(at)
        if kind not in self._plans:
            raise DamagedFrameError
        raw, at = _decode(self._plans[kind], self._data, at)
        if kind in "SGH":
            return None, at
        if kind == "P" and self._one is None:  # after damage: its length is known, its values are not
            return None, at
        frame = self._absolute(kind, raw)
        if self._last is not None:
            loops, late = frame[0] - self._last[0], frame[1] - self._last[1]
            if not (0 <= loops <= LATE_LOOPS and 0 <= late <= LATE_US):
                raise DamagedFrameError
        return frame, at

    def _absolute(self, kind: str, raw: list[int]) -> tuple[int, ...]:
        """Return the values of a main frame: predictions plus the differences in the frame."""
        one, two, signs = self._one, self._two, self._header.signed
        frame = list[int]()
        for k, (value, predictor) in enumerate(zip(raw, self._predictors[kind], strict=True)):
            if predictor == 0 or predictor > 6:
                expected = self._constant(predictor, frame)
            elif predictor == 4:
                expected = self._min_throttle
            elif predictor == 5:
                expected = frame[self._first_motor] if k > self._first_motor else 0
            elif one is None or two is None:
                raise DamagedFrameError
            elif predictor == 1:
                expected = one[k]
            elif predictor == 2:
                expected = 2 * one[k] - two[k]
            elif predictor == 3:
                total = one[k] + two[k]
                expected = total >> 1 if total >= 0 else -(-total >> 1)  # rounds towards zero
            else:
                expected = one[k] + 1 + self._count_skips(one[k])
            value += expected
            frame.append((value + HALF) % FULL_RANGE - HALF if signs[k] else value % FULL_RANGE)
        return tuple(frame)

    def _constant(self, predictor: int, frame: list[int]) -> int:
        return {8: CENTRE, 9: self._battery, 11: self._min_motor, 10: self._last[1] if self._last else 0}.get(
            predictor, 0
        )

    def _count_skips(self, loop: int) -> int:
        """Return how many loops after this one are not logged."""
        if self._number == self._count:
            return 0
        every = int(self._header.numbers("I interval", (32.0,))[0]) or 1
        for skip in range(self._count):
            if ((loop + 1 + skip) % every + self._number - 1) % self._count < self._number:
                return skip
        return 0

    def _event(self, at: int) -> int:
        """Return the offset behind an event; ``END`` for the end of the log."""
        data, kind = self._data, self._data[at]
        at += 1
        if kind == 255:
            if not data.startswith(LAST, at):
                raise DamagedFrameError
            return END
        if kind == 13:  # an adjustment in flight: a float or an integer
            if data[at] & 128:
                _ = data[at + 4]
                return at + 5
            return read_signed(data, at + 1)[1]
        if kind == 14:  # the log continues after a pause
            loop, at = read_unsigned(data, at)
            time, at = read_unsigned(data, at)
            if self._last is not None and time >= self._last[1]:
                self._last = (loop, time)
            return at
        for _ in range({0: 1, 15: 1, 30: 2}.get(kind, 0)):
            _, at = read_unsigned(data, at)
        if kind not in (0, 15, 30):
            raise DamagedFrameError
        return at


def _decode(plan: list[tuple[Decode, int]], data: bytes, at: int) -> tuple[list[int], int]:
    values = list[int]()
    for decode, count in plan:
        part, at = decode(data, at, count)
        values.extend(part)
    return values, at
