"""Check Python names in files and messages at the trust boundary.

Registered names are always allowed. ``module:name`` imports a module and calls one of its objects. Such a name is
accepted on the command line and in Python. In a file or a message it is rejected, unless the user also passes it as
``--trust mine:task`` or ``trust=("mine:task",)``.

Readers of policies, learner states, presets, sweeps and network messages call :func:`check_trust` before they build
anything. Code that starts processes passes on :func:`python_names` of the names that the user gave.
"""

import dataclasses
import re
from collections.abc import Collection, Iterator, Mapping
from typing import Any

from ..errors import ConfigError, excerpt

CSV_FILE = re.compile(r"[^:]*\.csv(:(laps|once))?", re.IGNORECASE)
"""Name of a trajectory file. Its colon precedes a choice between laps and one pass, not a Python name."""
REFERENCE_KEYS = ("reference", "references")
FREE_TABLE = "options"
"""Table of a custom task, in which this package does not look up names."""


def python_names(values: Any) -> tuple[str, ...]:
    """Return the Python names that building ``values`` would import.

    Args:
        values: A preset, a scenario, a name, or tables and lists of them.
    """
    return tuple(dict.fromkeys(_names(values)))


def check_trust(values: Any, trust: Collection[str], *, source: str) -> None:
    """Reject Python names in a file or message, except those that the user trusts.

    Args:
        values: Content of the file or message, before anything is built from it.
        trust: Names that the user trusts, e.g. ``mine:task``.
        source: Source of the values, with which the error message begins.

    Raises:
        ConfigError: The values contain a name that the user does not trust.
    """
    for name in python_names(values):
        if name not in trust:
            raise ConfigError(
                f"{source}: names Python code, {excerpt(name)}, which is not imported from a file or message; if you "
                f"trust it, pass --trust {excerpt(name, quotes=False)}, or trust=({excerpt(name)},) in Python"
            )


def _names(values: Any, is_reference: bool = True) -> Iterator[str]:
    """Yield the Python names; only a reference may be a trajectory file."""
    if isinstance(values, str):
        parts = (part.partition("=")[0] for part in values.split("+"))
        yield from (part for part in parts if ":" in part and not (is_reference and CSV_FILE.fullmatch(part)))
    elif isinstance(values, Mapping):
        for key, value in values.items():
            if key != FREE_TABLE:
                yield from _names(value, key in REFERENCE_KEYS)
    elif isinstance(values, list | tuple):
        for value in values:
            yield from _names(value, is_reference)
    elif dataclasses.is_dataclass(values) and not isinstance(values, type):
        for field in dataclasses.fields(values):
            if field.name != FREE_TABLE:
                yield from _names(getattr(values, field.name), field.name in REFERENCE_KEYS)
