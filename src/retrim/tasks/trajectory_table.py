"""Read trajectory text files with separators, comments, a header and numbers; errors contain the faulty line."""

import csv
import math
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ..errors import ConfigError

COLUMN_NAMES = "t [s], x, y, z [m] and, if desired, yaw [rad]"
COLUMNS = ("t", "x", "y", "z", "yaw")
ALIASES = {"time": "t", "timestamp": "t", "heading": "yaw", "psi": "yaw"}
POSITION = re.compile(r"(?:p|pos|position)[_.]?([xyz])")
GAP_ROW = re.compile(
    r"_.*"
    r"|(?:v|vel|velocity|a|acc|accel|acceleration|a_lin|a_rot|j|jerk|s|snap|w|omega|rates?|alpha|tau|torque)[_.]?[xyz]"
    r"|(?:q|quat|orientation)[_.]?[wxyz]|q[0-3]|u[_.]?\d|thrust|roll|pitch|yaw_?(?:rate|dot)|d?heading_?rate"
)
"""Usual names of columns that positions and yaw determine, and names that begin with _; such columns are not read."""
UNITS = {
    "t": ("s", "sec", "second", "seconds"),
    **dict.fromkeys("xyz", ("m", "meter", "meters", "metre", "metres")),
    "yaw": ("rad", "radian", "radians"),
}
MAX_BYTES = 32 * 2**20
LARGEST_COORDINATE = 1000.0  # [m]
LARGEST_YAW = 2.0 * math.pi + 0.1  # [rad]; larger values look like degrees
LONGEST = 600.0  # [s]
FASTEST = 100.0  # [m/s] between points
SAME_TIME, SAME_PLACE, SAME_YAW = 1e-6, 1e-3, 0.02  # [s], [m], [rad]; a point this near the last one repeats it
LEAST_SPEED = 0.02  # [m/s]; a vehicle of up to 20 m/s appears slower than this if its times are in ms


def read_table(file: Path) -> np.ndarray:
    """Read the points of a trajectory file.

    Args:
        file: UTF-8 text with one point per line. Commas, semicolons, tabs or spaces separate the columns, and ``#``
            starts a comment. Blank lines, quotes and separators at the end of a line are ignored. A header names the
            columns, in any order: t (time, timestamp), x, y, z (p_x, pos_x, position.x), yaw (heading, psi), with or
            without units in brackets. Columns with the usual names of velocities, accelerations, quaternions, rates and
            thrusts are not read, since the positions determine them. Columns whose name begins with ``_`` are not read
            either. Without a header, the order is t, x, y, z[, yaw]. A comment that comes before the first point and
            contains the column names is also a header. A point that repeats the previous one, for example
            where two segments meet, is left out.

    Returns:
        One row per point: time since the first point [s], world position x, y, z [m], and unwrapped yaw [rad], which is
        0 without a yaw column.

    Raises:
        ConfigError: The file does not have this format (the message contains the line), times do not increase, or
            values are implausible.
        OSError: The file cannot be opened.
    """
    if file.exists() and not file.is_file():
        raise ConfigError(f"{file} is not a regular file")
    if file.exists() and (size := file.stat().st_size) > MAX_BYTES:
        raise ConfigError(f"{file}: {size} bytes, more than the {MAX_BYTES} that are accepted")
    try:
        text = file.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise ConfigError(f"{file} is not UTF-8 text; {COLUMN_NAMES} are expected, one point a line") from error
    columns: list[str] | None = None
    points, numbers = list[list[float]](), list[int]()
    for number, line, comment in _lines(text):
        where = f"{file}, line {number}"
        try:
            words = _words(line)
            if not points and columns is None:
                columns = _header(words, comment=comment)
                if columns is not None:
                    continue
            if comment:
                continue
            point = _point(words, columns or list(COLUMNS[: max(4, len(words))]))
            if points and len(point) != len(points[0]):
                raise ConfigError(f"{line!r} has {len(words)} columns, the first point {len(points[0])}")
            if points and _repeats(point, points[-1]):
                continue
            if points and point[0] <= points[-1][0]:
                raise ConfigError(f"time {point[0]:g} s does not come after {points[-1][0]:g} s")
        except ConfigError as error:
            raise ConfigError(f"{where}: {error}") from error
        points.append(point)
        numbers.append(number)
    if len(points) < 2:
        raise ConfigError(f"{file}: {len(points)} points; a trajectory needs at least two")
    table = np.array([[*point, 0.0][:5] for point in points])
    table[:, 0] -= table[0, 0]
    table[:, 4] = np.unwrap(table[:, 4])
    _check_times(table, numbers, file)
    return table


def _repeats(point: list[float], last: list[float]) -> bool:
    """Return whether a point has the same time, position and heading as the last one."""
    heading_change = math.remainder(point[4] - last[4], 2.0 * math.pi) if len(point) > 4 else 0.0
    near = math.dist(point[1:4], last[1:4]) <= SAME_PLACE and abs(heading_change) <= SAME_YAW
    return near and abs(point[0] - last[0]) <= SAME_TIME


def _lines(text: str) -> Iterator[tuple[int, str, bool]]:
    """Yield the number and content of every non-blank line, and whether the whole line is a comment."""
    for number, line in enumerate(text.splitlines(), start=1):
        content, _, comment = line.partition("#")
        if content.strip():
            yield number, content.strip(), False
        elif comment.strip():
            yield number, comment.strip(), True


def _words(line: str) -> list[str]:
    """Split a line at its separator: a tab, semicolon or comma if the line contains one, otherwise spaces.

    Raises:
        ConfigError: A quoted field is too long to be a number.
    """
    separator = next((sign for sign in "\t;," if sign in line), " ")
    if separator == " ":
        line = " ".join(re.sub(r"\s+(?=[\[(])", "", line).split())  # a unit belongs to its name
    try:
        words = [word.strip() for word in next(csv.reader([line], delimiter=separator, skipinitialspace=True))]
    except csv.Error as error:
        raise ConfigError(f"{error}; {COLUMN_NAMES} are expected") from error
    while words and not words[-1]:
        words.pop()
    return words


def _header(words: list[str], *, comment: bool) -> list[str] | None:
    """Return the column names in a header; None if the line is not a header.

    Raises:
        ConfigError: The header contains an unexpected column, or lacks a required one.
    """
    if not words or any(_number(word) is not None for word in words):
        return None
    parts = [re.fullmatch(r"([^\[(]*?)\s*(?:[\[(]\s*(.*?)\s*[\])])?", word) for word in words]
    names = [part[1].lower() if part else word for part, word in zip(parts, words, strict=True)]
    names = [ALIASES.get(name, POSITION.sub(r"\1", name) if POSITION.fullmatch(name) else name) for name in names]
    if comment and not set(COLUMNS[:4]) <= set(names):
        return None  # an ordinary comment
    for word, name, part in zip(words, names, parts, strict=True):
        if name not in COLUMNS:
            if GAP_ROW.fullmatch(name):
                continue
            raise ConfigError(
                f"column {word[:40]!r} is not known; {COLUMN_NAMES} are expected; a column whose name begins with _ "
                f"is not read"
            )
        if names.count(name) > 1:
            raise ConfigError(f"column {name!r} appears twice; {COLUMN_NAMES} are expected")
        unit = part[2] if part else None
        if unit is not None and unit.lower() not in UNITS[name]:
            raise ConfigError(f"column {word!r}: {name} is expected in {UNITS[name][0]}, not in {unit}")
    if missing := [name for name in COLUMNS[:4] if name not in names]:
        raise ConfigError(f"no column {', '.join(missing)}; {COLUMN_NAMES} are expected")
    return names


def _number(word: str) -> float | None:
    try:
        return float(word)
    except ValueError:
        return None


def _point(words: list[str], columns: list[str]) -> list[float]:
    """Return t, x, y, z and, if there is a column for it, yaw.

    Raises:
        ConfigError: The number of words is wrong, or a word is not a plausible number.
    """
    excerpt = ", ".join(words) if len(words) <= 6 else ", ".join(words[:6]) + ", ..."
    if len(words) != len(columns):
        raise ConfigError(f"'{excerpt}' has {len(words)} columns; {', '.join(columns)} are expected: {COLUMN_NAMES}")
    values = dict[str, float]()
    for name, word in zip(columns, words, strict=True):
        if name not in COLUMNS:
            continue
        value = _number(word)
        if value is None:
            raise ConfigError(f"{name} = {word!r} in '{excerpt}' is not a number; {COLUMN_NAMES} are expected")
        if not math.isfinite(value):
            raise ConfigError(f"{name} = {word!r} in '{excerpt}' is not finite")
        values[name] = value
    if far := [name for name in "xyz" if abs(values[name]) > LARGEST_COORDINATE]:
        raise ConfigError(
            f"{far[0]} = {values[far[0]]:g} m is beyond {LARGEST_COORDINATE:g} m; are the positions in m?"
        )
    if abs(values.get("yaw", 0.0)) > LARGEST_YAW:
        raise ConfigError(
            f"yaw = {values['yaw']:g} looks like degrees; radians between -2 pi and 2 pi are expected "
            "(a wrapped yaw is unwrapped)"
        )
    return [values[name] for name in COLUMNS if name in values]


def _check_times(table: np.ndarray, numbers: list[int], file: Path) -> None:
    steps = np.diff(table[:, 0])
    speeds = np.linalg.norm(np.diff(table[:, 1:4], axis=0), axis=1) / steps
    seconds, step = float(table[-1, 0]), float(np.median(steps))
    in_ms = "; are the times in ms? They are expected in s" if step >= 1.0 else ""
    if seconds > LONGEST:
        raise ConfigError(f"{file}: it lasts {seconds:g} s; at most {LONGEST:g} s can be flown{in_ms}")
    if in_ms and 0.0 < speeds.max() < LEAST_SPEED:
        raise ConfigError(f"{file}: its points are {step:g} s and {1e3 * speeds.max() * step:.1f} mm apart{in_ms}")
    k = int(np.argmax(speeds))
    if speeds[k] > FASTEST:
        raise ConfigError(
            f"{file}, line {numbers[k + 1]}: {speeds[k] * steps[k]:.3g} m in {steps[k]:.3g} s after the "
            f"previous point, {speeds[k]:.3g} m/s; are the positions in m and the times in s?"
        )
