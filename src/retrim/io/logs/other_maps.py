"""Maps that differ from one in one statement, in words: what may have been meant."""

import dataclasses
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple, get_args

import numpy as np

from . import log_map as maps
from .log_map import LogMap
from .series import Series

SIGNS = ((-1, 1, 1), (1, -1, 1), (1, 1, -1), (1, -1, -1), (-1, -1, 1), (-1, 1, -1), (-1, -1, -1))
STATEMENTS = (
    ("velocity", "axes"), ("velocity", "unit"), ("position", "unit"), ("attitude", "turns"), ("attitude", "form"),
    ("thrust", "unit"), ("rates", "unit"), ("measured_rates", "unit"),
)  # fmt: skip


class Other(NamedTuple):
    """Another way to read a log."""

    words: str
    """The statement of the map that says so."""
    log_map: LogMap
    turns: Mapping[str, np.ndarray]
    """By which the columns of quantities are multiplied from the right."""

    def applied(self, series: Mapping[str, Series]) -> dict[str, Series]:
        """Return the series as they are then."""
        return {
            name: Series(each.t, each.values @ self.turns[name]) if name in self.turns else each
            for name, each in series.items()
        }


def others(chosen: LogMap) -> Iterator[Other]:
    """Return maps that differ in one unit, form, frame or sign, or in both frames."""
    for table, key in STATEMENTS:
        spec: Any = getattr(chosen, table)
        if spec is None:
            continue
        for value in _values(spec, key):
            if value == getattr(spec, key) or (table == "thrust" and value in ("N", "share")):
                continue
            if table == "attitude" and key == "form" and {value, spec.form} != {"xyzw", "wxyz"}:
                continue
            yield Other(f'{table}.{key} = "{value}"', _with(chosen, table, key, value), {})
    yield from _frames(chosen)
    yield from _signs(chosen)


def _frames(chosen: LogMap) -> Iterator[Other]:
    frames = chosen.frames
    for world, body in ((frames.world, other_body(frames.body)), (other_world(frames.world), frames.body),
                        (other_world(frames.world), other_body(frames.body))):  # fmt: skip
        words = " and ".join(
            [f'frames.world = "{world}"'] * (world != frames.world)
            + [f'frames.body = "{body}"'] * (body != frames.body)
        )
        yield Other(words, dataclasses.replace(chosen, frames=maps.Frames(world, body)), {})
        if chosen.attitude.world is None and chosen.attitude.body is None:
            words = words.replace("frames.", "attitude.")
            attitude = dataclasses.replace(chosen.attitude, world=world, body=body)
            yield Other(words, dataclasses.replace(chosen, attitude=attitude), {})


def other_world(name: str) -> str:
    """Return the usual world whose z points the other way."""
    return "NED" if "U" in name else "ENU"


def other_body(name: str) -> str:
    """Return the usual body whose z points the other way."""
    return "FRD" if "U" in name else "FLU"


def _signs(chosen: LogMap) -> Iterator[Other]:
    """Other signs of the numbers of a quantity; and x and y in each other's place, with z the other way."""
    for table in ("position", "velocity", "attitude", "rates", "measured_rates"):
        spec: Any = getattr(chosen, table)
        if spec is None or (table == "attitude" and spec.form in ("matrix", "rotation vector")):
            continue
        quaternion = table == "attitude" and spec.form in ("xyzw", "wxyz")
        for signs in SIGNS:
            if quaternion and signs == (-1, -1, -1):
                continue  # the inverse, which `turns` says
            row = signs if not quaternion else (*signs, 1) if spec.form == "xyzw" else (1, *signs)
            yield Other(f"{table}.fields = {_words(spec, row)}", chosen, {table: np.diag(np.array(row, dtype=float))})
        if table in ("position", "velocity") and (table == "position" or spec.axes == "world"):
            swap = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
            yield Other(f"x and y of {table}.fields in each other's place and a minus before z", chosen, {table: swap})


def _words(spec: Any, signs: tuple[int, ...]) -> str:
    """Return fields with other signs, as a map writes them."""
    if len(spec.fields) != len(signs):
        return f"the signs {list(signs)} of the numbers in {', '.join(spec.fields)}"
    names = [
        name if sign > 0 else name[1:] if name.startswith("-") else f"-{name}"
        for name, sign in zip(spec.fields, signs, strict=True)
    ]
    return "[" + ", ".join(f'"{name}"' for name in names) + "]"


def _values(spec: Any, key: str) -> tuple[Any, ...]:
    kind = next(field.type for field in dataclasses.fields(spec) if field.name == key)
    return get_args(kind)


def _with(chosen: LogMap, table: str, key: str, value: Any) -> LogMap:
    changes = {key: value} | (
        {"mass": None, "hover": None, "full": 1.0} if table == "thrust" else {}
    )  # what goes with one unit only
    return dataclasses.replace(chosen, **{table: dataclasses.replace(getattr(chosen, table), **changes)})
