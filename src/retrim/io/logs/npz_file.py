"""Reads NPZ logs: arrays whose first axis is time, such as those that `retrim fly` writes."""

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

import numpy as np

from ...errors import LogError
from .npz_members import NpzMembers
from .series import Clock, Series, find_fields, missing_field, sign_of


def read_npz(
    path: Path, request: Mapping[str, Sequence[str]], time: Clock | None, optional: Collection[str] = ()
) -> tuple[dict[str, Series], list[str]]:
    """Read the arrays of an NPZ file; ``u[1:4]`` selects columns. See :class:`~retrim.io.logs.series.LogReader`."""
    if time is None:
        raise LogError(f'{path}: an NPZ file needs a table [time] in the map, as field = "t" and unit = "s"')
    arrays = NpzMembers(path)
    times = _flat(path, time.field, arrays)
    if times.shape[1] != 1:
        raise LogError(f"{path}: {time.field!r} holds {times.shape[1]} numbers per sample, not a time")
    t = times[:, 0] * time.scale
    result = dict[str, Series]()
    for what, parts in find_fields(request, lambda each: _flat(path, each, arrays), optional):
        for name, column in zip(request[what], parts, strict=True):
            if len(column) != len(t):
                raise LogError(f"{path}: {name!r} has {len(column)} samples, but {time.field!r} has {len(t)}")
        columns = [sign_of(name) * column for name, column in zip(request[what], parts, strict=True)]
        result[what] = Series(t, np.concatenate(columns, axis=1))
    return result, []


def _flat(path: Path, name: str, arrays: NpzMembers) -> np.ndarray:
    """Return an array with one row per sample."""
    base, _, part = name.partition("[")
    if base not in arrays:
        raise missing_field(path, base, list(arrays))
    array = arrays[base]
    if array.ndim == 0 or array.size == 0 or array.dtype.kind not in "fiu":
        raise LogError(f"{path}: {base!r} is not an array of numbers over time")
    columns = array.reshape(len(array), -1).astype(float)
    if not part:
        return columns
    first, _, last = part.rstrip("]").partition(":")
    try:
        column_part = columns[:, int(first) : int(last) if last else int(first) + 1]
    except ValueError as error:
        raise LogError(f"{path}: field {name!r}: the columns must be as [0] or [0:3]") from error
    if not column_part.size:
        raise LogError(f"{path}: field {name!r}: {base!r} has {columns.shape[1]} columns")
    return column_part
