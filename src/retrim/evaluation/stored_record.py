"""Validates records of flights that were read from a file, which anything can have changed."""

import re
from collections.abc import Mapping
from typing import Any

from .metrics import CONDITIONS, FIGURES

TEXTS = ("preset", "disturbance", "method", "plant", "vehicle", "sensors", "fault", "metric")
TEXTS_OR_NONE = ("reference", "failed")
SIGNED = ("thrust_error", "behind_s")
LARGEST = 1e9  # no figure of a flight is larger, in any unit
NAMES = frozenset({"key", "preset", "seed", "start", "metric", "crashed", "failed", "method", *CONDITIONS, *FIGURES})


def is_record(row: Any, conditions: Mapping[str, Mapping[str, Any]]) -> bool:
    """Return whether a row is the record of a flight, with its key, and valid in itself.

    Args:
        row: The row; any JSON value.
        conditions: Conditions of each flight that is to be reported, by its key. A row with the key of another flight,
            for example of a larger sweep, may have any conditions.
    """
    if not (isinstance(row, dict) and row.keys() >= NAMES):
        return False
    texts = all(isinstance(row[name], str) or (name in TEXTS_OR_NONE and row[name] is None)
                for name in (*TEXTS, *TEXTS_OR_NONE))  # fmt: skip
    numbers = all(_is_number(row[name], name) for name in ("thrust_error", "delay", *FIGURES))
    counts = all(type(row[name]) is int and row[name] >= 0 for name in ("seed", "start"))
    if not (texts and numbers and counts and type(row["crashed"]) is bool and _is_key(row["key"])):
        return False
    has_no_error = row["crashed"] or row["failed"] is not None
    expected = conditions.get(row["key"], {})
    return (row["error"] is None) == has_no_error and all(row[name] == value for name, value in expected.items())


def _is_key(key: Any) -> bool:
    """Return whether a value is a key of a flight, which is also a part of a file's name."""
    return isinstance(key, str) and re.fullmatch("[0-9a-f]{16}", key) is not None


def _is_number(value: Any, name: str) -> bool:
    """Return whether a value is a finite number in the range of its quantity; figures may be None."""
    if value is None:
        return name in FIGURES
    return type(value) in (int, float) and (-LARGEST if name in SIGNED else 0.0) <= value <= LARGEST
