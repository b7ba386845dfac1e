"""Values as tables, for overlays of presets."""

import dataclasses
from typing import Any


def table_of(value: Any) -> dict[str, Any]:
    """Return a dataclass as a plain dictionary; None as an empty one."""
    return {} if value is None else dataclasses.asdict(value)
