"""Keys of preset tables that have a new name; files with the old name still load."""

import json
from typing import Any

from ..errors import ConfigError

RENAMED = {"track": {"felt_copies": "gravity_copies", "felt_push": "gravity_push"}}
"""New name of each old key, by table."""


def with_new_keys(tables: dict[str, Any], *, source: str) -> dict[str, Any]:
    """Return the tables of a preset with old keys replaced by their new names.

    Args:
        tables: Tables of a preset, or a part of them.
        source: Source of the tables, with which error messages begin.

    Raises:
        ConfigError: A table contains both names of a key.
    """
    result = dict(tables)
    for table, names in RENAMED.items():
        if isinstance(content := tables.get(table), dict):
            for old, new in names.items():
                if old in content and new in content:
                    raise ConfigError(f"{source}: {table}.{old} is now {table}.{new}; remove {table}.{old}")
            result[table] = {names.get(key, key): value for key, value in content.items()}
    return result


def text_with_new_keys(text: str | bytes, *, source: str) -> str | bytes:
    """Return the JSON of a preset with old keys replaced; return a text without old keys unchanged.

    Raises:
        ConfigError: As for :func:`with_new_keys`.
    """
    plain = text.decode(errors="replace") if isinstance(text, bytes) else text
    if not any(f'"{old}"' in plain for names in RENAMED.values() for old in names):
        return text
    try:
        tables = json.loads(plain)
    except (ValueError, RecursionError):
        return text  # the validation reports the mistake
    return json.dumps(with_new_keys(tables, source=source)) if isinstance(tables, dict) else text
