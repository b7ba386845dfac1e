"""Reads CSV logs: a header and one line per sample; a cell may contain a list, for example ``"[0.1, 0.2, 0.3]"``."""

import csv
import json
import re
from collections.abc import Collection, Mapping, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np

from ...errors import LogError
from .series import Clock, Series, find_fields, missing_field, sign_of


def read_csv(
    path: Path, request: Mapping[str, Sequence[str]], time: Clock | None, optional: Collection[str] = ()
) -> tuple[dict[str, Series], list[str]]:
    """Read the columns of a CSV file; see :class:`~retrim.io.logs.series.LogReader`.

    ``p[0]`` and ``p[0:3]`` select numbers from a column of lists. If there is no exact match for a name, case is
    ignored.
    """
    return series_of_rows(path, rows_of_file(path), request, time, optional)


def series_of_rows(
    path: Path,
    rows: list[tuple[int, list[str]]],
    request: Mapping[str, Sequence[str]],
    time: Clock | None,
    optional: Collection[str],
) -> tuple[dict[str, Series], list[str]]:
    """Return the columns of rows, the first of which is the header; see :func:`read_csv`."""
    if time is None:
        raise LogError(f'{path}: a CSV file needs a table [time] in the map, as field = "t" and unit = "s"')
    header, lines = _split_header(path, rows)
    places = {"": [_place(path, time.field, header)]}
    places.update(find_fields(request, lambda each: _place(path, each, header), optional))
    notes = list[str]()
    if lines and len(lines[-1][1]) < len(header):
        notes.append(f"line {lines[-1][0]}, the last, is torn, and is left out")
        lines.pop()
        if not lines:
            raise LogError(f"{path}: it has a header and no whole sample")
    columns: dict[int, list[list[float]]] = {
        place: [] for parts_of_place in places.values() for place, _ in parts_of_place
    }
    for number, cells in lines:
        if len(cells) != len(header):
            raise LogError(f"{path}, line {number}: {len(cells)} cells, but the header has {len(header)}")
        for place, column in columns.items():
            column.append(_numbers(cells[place], f"{path}, line {number}, column {header[place]!r}"))
    arrays = {place: _array(path, header[place], rows) for place, rows in columns.items()}
    times = arrays[places[""][0][0]][:, places[""][0][1]]
    if times.shape[1] != 1:
        raise LogError(f"{path}: column {time.field!r} holds lists, not times")
    result = dict[str, Series]()
    for what, parts_of_place in list(places.items())[1:]:
        parts = [
            sign_of(name) * _part(path, name, arrays[place], part)
            for name, (place, part) in zip(request[what], parts_of_place, strict=True)
        ]
        result[what] = Series(time.scale * times[:, 0], np.concatenate(parts, axis=1))
    return result, notes


def rows_of_file(path: Path) -> list[tuple[int, list[str]]]:
    """Return the non-empty lines of a file with their line numbers."""
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            first = file.readline()
            file.seek(0)
            delimiter = max(",;\t", key=first.count)
            rows = [(number, row) for number, row in enumerate(csv.reader(file, delimiter=delimiter), 1) if any(row)]
    except (UnicodeDecodeError, csv.Error) as error:
        raise LogError(f"{path}: not a text file of columns ({error})") from error
    if not rows:
        raise LogError(f"{path}: it is empty")
    return rows


def _split_header(path: Path, rows: list[tuple[int, list[str]]]) -> tuple[list[str], list[tuple[int, list[str]]]]:
    """Return the names of the columns, and the other rows."""
    header = [cell.strip() for cell in rows[0][1]]
    if len(rows) < 2:
        raise LogError(f"{path}: it has a header and no sample")
    if all(_is_number(cell) for cell in header):
        raise LogError(f"{path}: its first line holds numbers; the first line must name the columns")
    if twice := sorted({a for a, b in pairwise(sorted(header)) if a == b and a}):
        raise LogError(f"{path}: two columns are named {twice[0]!r}")
    return header, rows[1:]


def _place(path: Path, name: str, header: list[str]) -> tuple[int, slice]:
    """Return a field's column, and the slice of the numbers in it."""
    alike = [each.lower() for each in header]
    if name in header:
        return header.index(name), slice(None)
    if alike.count(name.lower()) == 1:
        return alike.index(name.lower()), slice(None)
    if (part := re.fullmatch(r"(.+)\[(\d+)(?::(\d+))?\]", name, re.ASCII)) and part[1] in header:
        first = int(part[2])
        return header.index(part[1]), slice(first, int(part[3]) if part[3] else first + 1)
    raise missing_field(path, name, [each for each in header if each])


def _part(path: Path, name: str, array: np.ndarray, part: slice) -> np.ndarray:
    columns = array[:, part]
    if not columns.size:
        raise LogError(f"{path}: field {name!r}: the column holds {array.shape[1]} numbers")
    return columns


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _numbers(cell: str, where: str) -> list[float]:
    """Return the numbers in a cell; NaN for an empty cell."""
    text = cell.strip()
    if not text:
        return [np.nan]
    try:
        return [float(x) for x in np.ravel(json.loads(text))] if text.startswith("[") else [float(text)]
    except (ValueError, TypeError, OverflowError, RecursionError) as error:
        raise LogError(f"{where}: {text[:40]!r} is not a number") from error


def _array(path: Path, name: str, rows: list[list[float]]) -> np.ndarray:
    """Return a column as an array; missing samples are NaN."""
    width = max(map(len, rows))
    for i, row in enumerate(rows):
        if len(row) != width:
            if len(row) > 1:
                raise LogError(f"{path}: column {name!r} holds {width} numbers, but {len(row)} in sample {i + 1}")
            rows[i] = [np.nan] * width
    return np.array(rows, dtype=float)
