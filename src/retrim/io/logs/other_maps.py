"""Generates candidates for the intended map: maps that differ from a given map in one statement, each with a text."""

import dataclasses
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple, get_args

import numpy as np

from . import log_map as maps
from .axes import left_handed
from .log_map import LogMap
from .series import Series

SIGNS = ((-1, 1, 1), (1, -1, 1), (1, 1, -1), (1, -1, -1), (-1, -1, 1), (-1, 1, -1), (-1, -1, -1))
STATEMENTS = (
    ("velocity", "axes"), ("velocity", "unit"), ("position", "unit"), ("attitude", "turns"), ("attitude", "form"),
    ("thrust", "unit"), ("rates", "unit"), ("measured_rates", "unit"),
)  # fmt: skip


class Other(NamedTuple):
    """An alternative map for a log."""

    words: str
    """Text of the changed statement."""
    log_map: LogMap
    turns: Mapping[str, np.ndarray]
    """Matrices that multiply the quantities' columns from the right."""

    def apply(self, series: Mapping[str, Series]) -> dict[str, Series]:
        """Return the series after multiplication by ``turns``."""
        return {
            name: Series(each.t, each.values @ self.turns[name]) if name in self.turns else each
            for name, each in series.items()
        }


def others(log_map: LogMap) -> Iterator[Other]:
    """Return maps that differ in one unit, form, frame or sign, or in both frames."""
    for table, key in STATEMENTS:
        spec: Any = getattr(log_map, table)
        if spec is None:
            continue
        for value in _values(spec, key):
            if value == getattr(spec, key) or (table == "thrust" and value in ("N", "share")):
                continue
            if table == "attitude" and key == "form" and {value, spec.form} != {"xyzw", "wxyz"}:
                continue
            yield Other(f'{table}.{key} = "{value}"', _with(log_map, table, key, value), {})
    yield from _frames(log_map)
    yield from _signs(log_map)


def with_heading(log_map: LogMap, degrees: float) -> Other:
    """Return a map with an additional rotation of the attitudes about the vertical."""
    heading = math.remainder(log_map.attitude.heading + round(degrees), 360.0)
    attitude = dataclasses.replace(log_map.attitude, heading=heading)
    return Other(f"attitude.heading = {heading:.0f}", dataclasses.replace(log_map, attitude=attitude), {})


def _frames(log_map: LogMap) -> Iterator[Other]:
    frames = log_map.frames
    pairs = [
        (frames.world, other_body(frames.body)),
        (other_world(frames.world), frames.body),
        (other_world(frames.world), other_body(frames.body)),
    ]
    for world, body in pairs:
        if left_handed(world) == left_handed(body):
            words = _differences("frames", (frames.world, frames.body), (world, body))
            yield Other(words, dataclasses.replace(log_map, frames=maps.Frames(world, body)), {})
    own = log_map.attitude.world or frames.world, log_map.attitude.body or frames.body
    variants = [(world, own[1]) for world in turn_about_z(own[0], "ENWS")]
    variants += [(own[0], body) for body in turn_about_z(own[1], "FLBR")]
    for world, body in [*pairs, *variants]:
        if left_handed(world) == left_handed(body):
            attitude = dataclasses.replace(log_map.attitude, world=world, body=body)
            words = _differences("attitude", own, (world, body))
            yield Other(words, dataclasses.replace(log_map, attitude=attitude), {})


def _differences(table: str, old: tuple[str, str], new: tuple[str, str]) -> str:
    """Return the axes that differ, in the syntax of a map."""
    names = ("world", "body")
    statements = [f'{table}.{name} = "{b}"' for name, a, b in zip(names, old, new, strict=True) if a != b]
    return " and ".join(statements)


def turn_about_z(name: str, letters: str) -> list[str]:
    """Return other axes with the same vertical last axis and the same handedness."""
    if name[2] not in "UD":
        return []
    around = [letters[k] + letters[(k + step) % 4] + name[2] for k in range(4) for step in (1, 3)]
    return [each for each in around if left_handed(each) == left_handed(name) and each != name]


def other_world(name: str) -> str:
    """Return the usual world axes with the opposite z direction."""
    return "NED" if "U" in name else "ENU"


def other_body(name: str) -> str:
    """Return the usual body axes with the opposite z direction."""
    return "FRD" if "U" in name else "FLU"


def _signs(log_map: LogMap) -> Iterator[Other]:
    """Return maps in which a quantity's numbers have different signs, or a different order."""
    for table in ("position", "velocity", "attitude", "rates", "measured_rates"):
        spec: Any = getattr(log_map, table)
        if spec is None or (table == "attitude" and spec.form in ("matrix", "rotation vector")):
            continue
        quaternion = table == "attitude" and spec.form in ("xyzw", "wxyz")
        for signs in SIGNS:
            if quaternion and signs == (-1, -1, -1):
                continue  # this is the inverse, which `turns` covers
            row = signs if not quaternion else (*signs, 1) if spec.form == "xyzw" else (1, *signs)
            yield _arrange(log_map, table, range(len(row)), row)
        if table == "attitude" and not quaternion:
            for order in ((1, 0, 2), (2, 1, 0)):
                yield _arrange(log_map, table, order, (1, 1, 1))
        if table != "attitude":
            for signs in ((1, 1, 1), *SIGNS):
                yield _arrange(log_map, table, (1, 0, 2), signs)


def _arrange(log_map: LogMap, table: str, order: Sequence[int], signs: Sequence[int]) -> Other:
    """Return a map with the fields in a different order, each with a sign."""
    spec: Any = getattr(log_map, table)
    turn = np.zeros((len(order), len(order)))
    for column, (row, sign) in enumerate(zip(order, signs, strict=True)):
        turn[row, column] = sign
    if len(spec.fields) != len(order):
        entries = ", ".join("-" * (sign < 0) + str(row) for row, sign in zip(order, signs, strict=True))
        words = f"the numbers {entries} of {', '.join(spec.fields)} for {table}.fields"
    else:
        names = [(spec.fields[row], sign) for row, sign in zip(order, signs, strict=True)]
        signed_names = [name if sign > 0 else name[1:] if name.startswith("-") else f"-{name}" for name, sign in names]
        words = f"{table}.fields = [" + ", ".join(f'"{name}"' for name in signed_names) + "]"
    return Other(words, log_map, {table: turn})


def _values(spec: Any, key: str) -> tuple[Any, ...]:
    kind = next(field.type for field in dataclasses.fields(spec) if field.name == key)
    return get_args(kind)


def _with(log_map: LogMap, table: str, key: str, value: Any) -> LogMap:
    changes = {key: value} | (
        {"mass": None, "hover": None, "full": 1.0, "zero": 0.0, "curve": 0.0} if table == "thrust" else {}
    )  # these belong to a single unit
    return dataclasses.replace(log_map, **{table: dataclasses.replace(getattr(log_map, table), **changes)})
