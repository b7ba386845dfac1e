"""Read TOML files and validate tables against dataclasses, with one-line error messages."""

import dataclasses
import difflib
import tomllib
import typing
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, TypeVar

from pydantic import TypeAdapter, ValidationError

from ..errors import ConfigError, excerpt

T = TypeVar("T")

MAX_CHECKS, MAX_LINES = 100, 8
"""Largest number of mistakes per file that are examined, and largest number that are listed."""
UNKNOWN_KEY = "unknown key"
NO_NAME = "Input should be a valid string"
MAX_TOML_BYTES = 1_000_000


def read_toml(path: Path) -> dict[str, Any]:
    """Return the tables of a TOML file.

    Raises:
        ConfigError: The path is not a regular file, or the file is too large, unreadable or not valid TOML.
    """
    try:
        if not path.is_file():
            raise ConfigError(f"{path}: {'not a regular file' if path.exists() else 'no such file'}")
        if path.stat().st_size > MAX_TOML_BYTES:
            raise ConfigError(f"{path}: larger than the {MAX_TOML_BYTES} bytes that are accepted")
        return tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except ConfigError:
        raise
    except (ValueError, RecursionError) as error:  # an integer of 5,000 digits also raises ValueError
        raise ConfigError(f"{path}: not TOML ({error})") from error
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror})") from error


def validate(kind: type[T], tables: dict[str, Any] | str | bytes, *, source: str) -> T:
    """Build a dataclass from tables or JSON.

    Args:
        kind: Dataclass to build.
        tables: Values, as dictionaries or as JSON.
        source: Source of the values, with which error messages begin.

    Raises:
        ConfigError: A value is missing, unknown or impossible. The message lists the mistakes with their paths.
    """
    adapter = TypeAdapter(kind)
    try:
        return adapter.validate_python(tables) if isinstance(tables, dict) else adapter.validate_json(tables)
    except ValidationError as error:
        raise ConfigError(f"{source}: {_explain(kind, error)}") from error


def suggestion(name: str, names: Iterable[str]) -> str:
    """Return a text that suggests the closest known name and lists all known names."""
    near = difflib.get_close_matches(name[:100], names := list(names), n=1)
    return (f"did you mean {near[0]!r}? " if near else "") + f"there are {', '.join(names)}"


def _explain(kind: type[Any], error: ValidationError) -> str:
    """Return a text with the first mistakes: the path of each and, for an unknown key, the valid keys."""
    result, mistakes = dict[str, str](), error.errors(include_url=False, include_context=False)
    for each in mistakes[:MAX_CHECKS]:
        path = [excerpt(str(part), quotes=False) for part in each["loc"] if not str(part).startswith("function-")]
        where = ".".join(path)
        message = each["msg"].removeprefix("Value error, ")
        if each["type"] == "unexpected_keyword_argument":
            message = f"{UNKNOWN_KEY}; {suggestion(path[-1], _keys(kind, path[:-1]))}"
        elif each["type"] in ("missing", "missing_argument"):
            message = "is missing"
        elif each["type"] in ("tuple_type", "list_type"):
            message = f"must be a list of values in brackets, not {excerpt(str(each['input']), quotes=False)}"
        elif each["type"] not in ("value_error", "assertion_error", "json_invalid"):  # whose messages have the value
            message += f", not {excerpt(each['input'])}"
        if result.get(where, NO_NAME).startswith(NO_NAME):  # a table and a name are valid: prefer the table's mistake
            result[where] = message
    order = sorted(result.items(), key=lambda each: not each[1].startswith(UNKNOWN_KEY))  # typos explain missing keys
    lines = [f"{where}: {message}" if where else message for where, message in order][:MAX_LINES]
    more = len(result) - len(lines) + max(len(mistakes) - MAX_CHECKS, 0)
    return "; ".join(lines) + (f"; and {more} more" if more else "")


def _keys(kind: type[Any], path: Sequence[str]) -> list[str]:
    """Return the keys of the table at a path. Parts that are not keys, such as union members, are skipped."""
    for part in path:
        annotation = typing.get_type_hints(kind).get(part)
        parts = [each for each in (annotation, *typing.get_args(annotation)) if dataclasses.is_dataclass(each)]
        kind = typing.cast(type[Any], parts[0]) if parts else kind
    return [field.name for field in dataclasses.fields(kind)]
