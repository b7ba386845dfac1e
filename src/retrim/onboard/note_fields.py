"""Check the types and ranges of the fields of notes between processes before use."""

import math
from collections.abc import Callable, Mapping
from typing import Any

from ..errors import MessageError

Read = Callable[[Any], Any]
"""Function that checks and returns a JSON value, or raises ``ValueError`` with the requirement."""
LARGEST_INTEGER, LARGEST_NUMBER, LONGEST_TEXT = 2**53, 1e300, 1000
"""Limits of all readers: largest whole number, largest number, and maximum length of a text."""

# Largest values of `Stage` and `Cause` in retrim.control.condition, which needs JAX; a test checks that they agree.
LAST_STAGE, LAST_CAUSE = 4, 7


def format_value(value: Any) -> str:
    """Return a short text without control characters for a value in an error message."""
    text = ascii(value) if isinstance(value, str | int | float | bool | type(None)) else type(value).__name__
    return text if len(text) <= 80 else f"{text[:77]}..."


def plain(text: str) -> str:
    """Return a text with its control characters escaped and its length limited."""
    printable = "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text[: LONGEST_TEXT + 1])
    return printable if len(printable) <= LONGEST_TEXT else f"{printable[: LONGEST_TEXT - 3]}..."


def number(low: float = -math.inf, high: float = math.inf, *, finite: bool = True) -> Read:
    """Return a reader of numbers in a range; ``finite=False`` accepts NaN and infinity, which a flight may report."""

    def read(value: Any) -> float:
        if not isinstance(value, int | float) or isinstance(value, bool):
            raise ValueError("a number")
        if isinstance(value, float) and not math.isfinite(value) and not finite:
            return value
        if not max(low, -LARGEST_NUMBER) <= value <= min(high, LARGEST_NUMBER):
            raise ValueError(f"a number from {low:g} to {high:g}")
        return float(value)

    return read


def whole(low: int = 0, high: int = LARGEST_INTEGER) -> Read:
    """Return a reader of whole numbers in a range."""

    def read(value: Any) -> int:
        if not isinstance(value, int) or isinstance(value, bool) or not low <= value <= high:
            raise ValueError(f"a whole number from {low} to {high}")
        return value

    return read


def flag(value: Any) -> bool:
    """Read true or false."""
    if not isinstance(value, bool):
        raise ValueError("true or false")
    return value


def text(value: Any) -> str:
    """Read a text; escape its control characters and shorten it if it is long."""
    if not isinstance(value, str):
        raise ValueError("a text")
    return plain(value)


def maybe(read: Read) -> Read:
    """Return a reader that also accepts null."""
    return lambda value: None if value is None else read(value)


def list_of(*reads: Read, length: int | None = None) -> Read:
    """Return a reader of lists.

    Args:
        *reads: Reader of all items, or one reader for each item.
        length: Number of items, if there is a single reader; by default, any number.
    """
    exact = length if len(reads) == 1 else len(reads)

    def read(value: Any) -> list[Any]:
        if not isinstance(value, list | tuple) or exact not in (None, len(value)):
            raise ValueError("a list" if exact is None else f"a list of {exact}")
        kinds = reads * len(value) if len(reads) == 1 else reads
        return [kind(item) for kind, item in zip(kinds, value, strict=True)]

    return read


def map_of(read: Read) -> Read:
    """Return a reader of tables that map names to values of one kind."""

    def read_all(value: Any) -> dict[str, Any]:
        if not isinstance(value, dict):
            raise ValueError("a table")
        return {text(name): read(item) for name, item in value.items()}

    return read_all


_time, _any = number(), number(finite=False)
_vector = list_of(_any, length=3)
FIELDS: Mapping[str, Mapping[str, Read]] = {
    "airborne": {},
    "beat": {"count": whole()},
    "ended": {"reason": text},
    "followed": {"name": text},
    "ground": {"base": text, "alive": map_of(flag), "failed": text, "over": flag},
    "identified": {"reports": list_of(list_of(_time, text))},
    "knobs": {
        **dict.fromkeys(("push", "wind", "kick"), list_of(number(), length=3)),
        **{"load": number(), "rotor": number(), "kicks": whole()},
    },
    "learner": {"learnt": whole(), "took": number(0.0), "until": _time, "excluded": list_of(whole(), length=5)},
    "learning": {"paused": flag, "flown": flag},
    "order": {"epoch": maybe(number(0.0)), "order": text},
    "ready": {
        **dict.fromkeys(("base", "device"), text),
        **{"failed": maybe(text), "moved": text, "refused": list_of(text), "stands": flag, "port": whole(1, 65535)},
    },
    "refusals": {"count": whole(), "last": text, "fault": text},
    "stalls": {"count": whole(), "longest": number(0.0), "newest": list_of(list_of(_time, _time))},
    "status": {
        **dict.fromkeys(("mode", "reason"), text),
        **dict.fromkeys(("missed", "late_samples"), whole()),
        "stages": list_of(list_of(_time, whole(0, LAST_STAGE), whole(0, LAST_CAUSE))),
        **dict.fromkeys(("versions", "newest", "refused"), map_of(whole())),
        **dict.fromkeys(("disturbance", "estimate", "target"), _vector),
        "error": _any,
        "given_up": list_of(whole()),
        "swaps": list_of(list_of(_any, text, whole(), _any)),
        "gaps": list_of(list_of(_any, _any, whole())),
        "learning": flag,
    },
    "wish": {**dict.fromkeys(("method", "reference"), text), **dict.fromkeys(("paused", "land"), flag)},
    "world": {
        **dict.fromkeys(("late", "held"), whole()),
        "lost": maybe(number(0.0)),
        "knobs_refused": text,
        "notes": list_of(text),
    },
}
"""Fields of each kind of note, by the first part of its name; every field is optional."""


def read_fields(kind: str, fields: Any) -> dict[str, Any]:
    """Check the types and ranges of the fields of a note, and return the fields.

    Args:
        kind: Kind of the note, e.g. ``wish`` or ``learner.policy``.
        fields: Fields as received; unknown fields are returned unchanged.

    Raises:
        MessageError: The fields are not a table, or a field has the wrong type or range.
    """
    if not isinstance(fields, dict):
        raise MessageError(f"{kind}: no fields")
    known_fields, result = FIELDS.get(kind.partition(".")[0], {}), dict(fields)
    for name in known_fields.keys() & result.keys():
        try:
            result[name] = known_fields[name](result[name])
        except ValueError as error:
            raise MessageError(f"{kind}: {name} = {format_value(fields[name])} must be {error}") from None
    return result
