"""Logs as CSV: a header and one line per sample; a cell may hold a list, as ``"[0.1, 0.2, 0.3]"``."""

import csv
import json
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np

from ...errors import LogError
from .series import Clock, Series, missing_field


def read_csv(
    path: Path, wanted: Mapping[str, Sequence[str]], time: Clock | None
) -> tuple[dict[str, Series], list[str]]:
    """Read the columns of a CSV file; see :class:`~retrim.io.logs.series.LogReader`."""
    if time is None:
        raise LogError(f'{path}: a CSV file needs a table [time] in the map, as field = "t" and unit = "s"')
    header, lines = _lines(path)
    names = list(dict.fromkeys([time.field, *(name for fields in wanted.values() for name in fields)]))
    places = [_place(path, name, header) for name in names]
    notes = list[str]()
    if lines and len(lines[-1][1]) < len(header):
        notes.append(f"line {lines[-1][0]}, the last, is torn, and is left out")
        lines.pop()
    columns = dict[str, list[list[float]]]()
    for name in names:
        columns[name] = []
    for number, cells in lines:
        if len(cells) != len(header):
            raise LogError(f"{path}, line {number}: {len(cells)} cells, but the header has {len(header)}")
        for name, place in zip(names, places, strict=True):
            columns[name].append(_numbers(cells[place], f"{path}, line {number}, column {name!r}"))
    arrays = {name: _array(path, name, rows) for name, rows in columns.items()}
    if arrays[time.field].shape[1] != 1:
        raise LogError(f"{path}: column {time.field!r} holds lists, not times")
    t = time.scale * arrays[time.field][:, 0]
    return {
        what: Series(t, np.concatenate([arrays[name] for name in fields], axis=1)) for what, fields in wanted.items()
    }, notes


def _lines(path: Path) -> tuple[list[str], list[tuple[int, list[str]]]]:
    """Return the header, and each other line that is not empty with its number."""
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
    header = [cell.strip() for cell in rows[0][1]]
    if len(rows) < 2:
        raise LogError(f"{path}: it has a header and no sample")
    if all(_is_number(cell) for cell in header):
        raise LogError(f"{path}: its first line holds numbers; the first line must name the columns")
    if twice := sorted({a for a, b in pairwise(sorted(header)) if a == b and a}):
        raise LogError(f"{path}: two columns are named {twice[0]!r}")
    return header, rows[1:]


def _place(path: Path, name: str, header: list[str]) -> int:
    if name not in header:
        raise missing_field(path, name, [each for each in header if each])
    return header.index(name)


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _numbers(cell: str, where: str) -> list[float]:
    """Return the numbers of a cell; an empty one is not a number."""
    text = cell.strip()
    if not text:
        return [np.nan]
    try:
        return [float(x) for x in np.ravel(json.loads(text))] if text.startswith("[") else [float(text)]
    except (ValueError, TypeError, RecursionError) as error:
        raise LogError(f"{where}: {text[:40]!r} is no number") from error


def _array(path: Path, name: str, rows: list[list[float]]) -> np.ndarray:
    """Return a column as an array; samples that miss it are not a number."""
    width = max(map(len, rows))
    for i, row in enumerate(rows):
        if len(row) != width:
            if len(row) > 1:
                raise LogError(f"{path}: column {name!r} holds {width} numbers, but {len(row)} in sample {i + 1}")
            rows[i] = [np.nan] * width
    return np.array(rows, dtype=float)
