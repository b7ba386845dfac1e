"""Reads a Blackbox log that blackbox_decode or Blackbox Explorer has converted to CSV.

The numbers are in the units of the board. The settings that define these units stand above the table in a file of
Blackbox Explorer. A file of blackbox_decode has no settings, so that the range of the numbers decides.
"""

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

import numpy as np

from ...errors import LogError
from .blackbox_file import scale
from .blackbox_header import BlackboxHeader
from .csv_file import rows_of_file, series_of_rows
from .series import Clock, Series, missing_field, sign_of

TITLE = "loopIteration"
PREAMBLE = 1000  # largest number of settings above the table
SCALES = (256.0, 512.0, 1024.0, 2048.0, 4096.0, 8192.0)  # numbers of an accelerometer that mean one g
DSHOT, PWM = "158,2047", "1055,2000"  # motor range, with an idle command of 5.5 %


def read_decoded(
    path: Path, request: Mapping[str, Sequence[str]], time: Clock | None, optional: Collection[str] = ()
) -> tuple[dict[str, Series], list[str]]:
    """Read the columns of a decoded log, in the units of :func:`~retrim.io.logs.blackbox_file.read_blackbox`."""
    rows = rows_of_file(path)
    begin = next((k for k, (_, row) in enumerate(rows[:PREAMBLE]) if row[0].strip() == TITLE), None)
    if begin is None:
        raise missing_field(path, TITLE, [cell.strip() for cell in rows[0][1]])
    values = {row[0].strip(): ",".join(row[1:]).strip() for _, row in rows[:begin] if len(row) > 1}
    header = [cell.strip() for cell in rows[begin][1]]
    fields = {what: [each for name in names for each in _expand(name, header)] for what, names in request.items()}
    clock = None if time is None else Clock(_expand(time.field, header)[0], time.scale)
    raw, notes = series_of_rows(path, rows[begin:], fields, clock, optional)
    board = BlackboxHeader((), (), {}, values, 0)
    if not board.revision:
        notes.append("the CSV has no settings; the units of motors and accelerometer follow from its numbers")
    values |= _units(raw, fields, values)
    result = dict[str, Series]()
    for what, each in raw.items():
        names = fields[what]
        if each.values.shape[1] != len(names):
            raise LogError(f"{path}: a column of {what} holds lists of numbers")
        columns = [
            sign_of(name) * scale(board, name.removeprefix("-"), sign_of(name) * column)
            for name, column in zip(names, each.values.T, strict=True)
        ]
        result[what] = Series(each.t, np.stack(columns, axis=1))
    return result, notes


def _expand(field: str, header: list[str]) -> list[str]:
    """Return the columns of the first alternative that exists; ``motor`` is the whole array."""
    sign = "-" if field.startswith("-") else ""
    for name in field.removeprefix("-").split("|"):
        if name in header:
            return [sign + name]
        if columns := [each for each in header if each.startswith(f"{name}[")]:
            return [sign + each for each in columns]
    return [field]


def _units(raw: Mapping[str, Series], fields: Mapping[str, list[str]], values: Mapping[str, str]) -> dict[str, str]:
    """Return settings that are absent from the file, from the range of its numbers."""
    result = dict[str, str]()
    for what, each in raw.items():
        numbers = each.values[np.all(np.isfinite(each.values), axis=1)]
        if not len(numbers):
            continue
        if fields[what][0].startswith("accSmooth") and "acc_1G" not in values:
            size = max(float(np.median(np.linalg.norm(numbers, axis=1))), 1.0)
            result["acc_1G"] = str(min(SCALES, key=lambda one: abs(np.log(one / size))))
        if fields[what][0].startswith("motor") and "motorOutput" not in values:
            result["motorOutput"] = PWM if float(np.percentile(numbers, 5)) >= 1000.0 else DSHOT
    return result
