"""Reads Blackbox flight logs of Betaflight (``.bbl``, ``.bfl``), without any other package.

A field has the name in the log's header, for example ``gyroADC[0]``; ``motor`` is the whole array. Rates are in deg/s,
accelerations in g. Motor commands and ``setpoint[3]``, the throttle, are shares of the full motor command, in which the
idle command is not zero.
"""

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

import numpy as np

from ...errors import LogError
from .blackbox_codes import DamagedFrameError
from .blackbox_frames import FrameDecoder
from .blackbox_header import BEGIN, BlackboxHeader, read_header
from .body_reader import FILTER
from .flights import Span, choose_flight
from .series import Clock, Series, first_of, missing_field, sign_of

MICROSECOND = 1e-6
TIME = "time"
TAIL = 64 * 1024  # part of a flight that is searched for its last main frame [bytes]
MOST_FLIGHTS = 1000
SLOW_LOOP_FACTOR = 3.0  # factor by which a loop may be slower than its setting
FINE_FACTOR = 10.0  # factor of rates in a log of high resolution
SETTINGS = {"gyro": "blackbox_disable_gyro", "motor": "blackbox_disable_motors"}
TWO_POLES = 1.554  # ratio of the cut-off of each of two equal poles to that of both together
DSHOT, PWM = (48.0, 2047.0), (1000.0, 2000.0)  # motor commands without thrust, and at full thrust


def read_blackbox(
    path: Path,
    request: Mapping[str, Sequence[str]],
    time: Clock | None,
    optional: Collection[str] = (),
    flight: int | None = None,
) -> tuple[dict[str, Series], list[str]]:
    """Read fields of one flight; see :class:`~retrim.io.logs.series.LogReader`.

    Args:
        path: The file.
        request: Fields of each quantity.
        time: Not used; the log has its own times.
        optional: Quantities that may be missing.
        flight: Number of the flight in the file, from 1.
    """
    data = path.read_bytes()
    headers = _headers(path, data)
    spans = [_span(data, header, end) for header, end in headers]
    k, notes = choose_flight(path, spans, flight)
    header, end = headers[k]
    if not header.revision.startswith("Betaflight"):
        raise LogError(f"{path}: it was written by {header.revision or 'an unknown firmware'}, not by Betaflight")
    places = dict[str, list[list[str]]]()
    for what, fields in request.items():
        try:
            places[what] = [first_of(name, lambda each: _find(path, each, header.names)) for name in fields]
        except LogError as error:
            if what not in optional:
                raise _absent(path, fields[0], error) from error
    names = list(dict.fromkeys([TIME, *(each for parts in places.values() for part in parts for each in part)]))
    frames = FrameDecoder(data, header, end).decode(names)
    t = MICROSECOND * frames.columns[TIME]
    if len(t) < 2:
        raise LogError(f"{path}: {len(t)} samples can be read in this flight; the log is empty or damaged")
    notes.append(f"the log is that of {header.revision}")
    if frames.damaged:
        notes.append(f"{frames.damaged} frames are damaged, and are left out")
    if not frames.complete:
        notes.append("the log ends without its end mark; what is there is used")
    result = dict[str, Series]()
    for what, parts in places.items():
        columns = [
            sign_of(field) * scale(header, name, frames.columns[name])
            for field, part in zip(request[what], parts, strict=True)
            for name in part
        ]
        result[what] = Series(t, np.stack(columns, axis=1))
    cutoff = header.numbers("acc_lpf_hz", (0.0,))[0] / 100.0
    if "acceleration" in result and 1.0 <= cutoff <= 1000.0:
        result[FILTER] = Series(t[:1], np.full((1, 1), 1.0 / (np.pi * cutoff * TWO_POLES)))
        notes.append(f"the accelerometer's filter of {cutoff:g} Hz is accounted for")
    return result, notes


def _absent(path: Path, name: str, error: LogError) -> LogError:
    """Return the error for a field that the log needs; it names the setting that logs it."""
    for base, setting in SETTINGS.items():
        if name.startswith(base):
            words = f"the log has no {name.split('|')[-1].partition('[')[0]}; `set {setting} = OFF` logs it"
            return LogError(f"{path}: {words}")
    return error


def scale(header: BlackboxHeader, name: str, values: np.ndarray) -> np.ndarray:
    """Return a field's values in deg/s, g, or shares of the full motor command; other fields are unchanged."""
    base = name.partition("[")[0]
    fine = FINE_FACTOR if header.values.get("blackbox_high_resolution", "0").startswith("1") else 1.0
    low = header.numbers("motorOutput", (0.0, 0.0))[0]
    zero, full = PWM if low >= PWM[0] else DSHOT
    if base in ("gyroADC", "gyroUnfilt"):
        return values * header.gyro_scale / fine
    if base == "accSmooth":
        return values / (header.numbers("acc_1G", (0.0,))[0] or 2048.0)
    if base == "motor":
        return (values - zero) / (full - zero)
    idle = max(0.0, (low - zero) / (full - zero)) if low > 0.0 else 0.0
    if name == "setpoint[3]":
        return idle + (1.0 - idle) * values / 1000.0
    if name == "rcCommand[3]":
        return idle + (1.0 - idle) * (values / fine - PWM[0]) / (PWM[1] - PWM[0])
    return values / fine if base in ("setpoint", "rcCommand") else values


def _headers(path: Path, data: bytes) -> list[tuple[BlackboxHeader, int]]:
    """Return the header and the end of each flight that has frames."""
    begins, at = list[int](), data.find(BEGIN)
    while at >= 0 and len(begins) < MOST_FLIGHTS:
        begins.append(at)
        at = data.find(BEGIN, at + 1)
    if not begins:
        raise LogError(f"{path}: it is not a Blackbox log: no flight begins in it")
    result, first = list[tuple[BlackboxHeader, int]](), None
    for begin, end in zip(begins, [*begins[1:], len(data)], strict=True):
        try:
            header = read_header(path, data, begin)
            FrameDecoder(b"", header, 0)
        except LogError as error:
            first = first or error
        except DamagedFrameError:
            first = first or LogError(f"{path}: the header of the Blackbox log is damaged: a group of fields is torn")
        else:
            if header.end < end:
                result.append((header, end))
    if not result:
        raise first or LogError(f"{path}: the Blackbox log has a header and no sample")
    return result


def _span(data: bytes, header: BlackboxHeader, end: int) -> Span:
    """Return the times of a flight's first and last main frames, which its whole length need not be decoded for."""
    decoder = FrameDecoder(data, header, end)
    every = int(header.numbers("I interval", (32.0,))[0]) or 1
    loop_time = header.numbers("looptime", (0.0,))[0] * max(1.0, header.numbers("pid_process_denom", (1.0,))[0])
    first = next(decoder.main_frames_after(header.end), None)
    if first is None:
        return Span(0.0, 0.0)
    last, at = first[1], max(header.end, end - TAIL)
    for loop, time in decoder.main_frames_after(at):
        loops = loop - first[0]
        fits = loop_time <= 0.0 or time - first[1] <= SLOW_LOOP_FACTOR * loop_time * loops + 1e6
        if loop % every == 0 and loops >= 0 and fits:
            last = max(last, time)
    return Span(MICROSECOND * first[1], MICROSECOND * last)


def _find(path: Path, name: str, names: Sequence[str]) -> list[str]:
    """Return the columns of a field or of a whole array."""
    if name in names:
        return [name]
    columns = [each for each in names if each.startswith(f"{name}[")]
    if not columns:
        raise missing_field(path, name, names)
    return columns
