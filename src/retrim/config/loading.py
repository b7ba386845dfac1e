"""Presets from names, TOML files, flags and JSON; every mistake is one clear line."""

import dataclasses
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from ..errors import ConfigError
from .named_presets import PRESETS
from .presets import BUILT_IN_TASKS, Preset
from .validation import read_toml, suggestion, validated
from .vehicle_file import read_vehicle


def load(name: str, overlay: Path | None = None) -> Preset:
    """Return a preset.

    Args:
        name: As ``hover/fast``; ``PRESETS`` has all of them.
        overlay: A TOML file with values on top.

    Raises:
        ConfigError: There is no such preset, or the file cannot be used.
    """
    if name not in PRESETS:
        raise ConfigError(f"no preset {name!r}; {suggestion(name, PRESETS)}")
    return PRESETS[name] if overlay is None else overlaid(PRESETS[name], overlay)


def load_for(task: str, name: str) -> Preset:
    """Return a preset for a task: ``fast`` is short for ``hover/fast``. A task of one's own takes those for hover.

    Raises:
        ConfigError: There is no such preset, or it is for another task.
    """
    preset = load(f"{task}/{name}" if f"{task}/{name}" in PRESETS else name)
    if preset.task == task:
        return preset
    if task in BUILT_IN_TASKS or preset.task != "hover":
        raise ConfigError(f"preset {preset.name!r} is for {preset.task}, not for {task}")
    return changed(preset, task=task, name=f"{task} on {preset.name}")


def overlaid(preset: Preset, overlay: Path) -> Preset:
    """Return a preset with the values of a TOML file on top.

    Args:
        preset: What lies below.
        overlay: The file; a relative vehicle file in it is looked up beside it.

    Raises:
        ConfigError: The file cannot be read, is not TOML, or has a key or value that does not fit.
    """
    above = read_toml(overlay)
    if isinstance(above.get("vehicle"), str) and above["vehicle"].endswith(".toml"):
        above["vehicle"] = dataclasses.asdict(read_vehicle(overlay.parent / above["vehicle"]))
    return validated(Preset, merged(values(preset), above), source=str(overlay))


def values(preset: Preset) -> dict[str, Any]:
    """Return the preset as plain dictionaries and numbers."""
    return dataclasses.asdict(preset)


def parse(text: str | bytes, *, source: str) -> Preset:
    """Return a preset from JSON, the inverse of :func:`dump`.

    Raises:
        ConfigError: It is not a preset.
    """
    return validated(Preset, text, source=source)


def changed(preset: Preset, **tables: Any) -> Preset:
    """Return a preset with some values replaced, as in ``changed(preset, adapt={"num_updates": 5})``.

    Args:
        preset: What lies below.
        **tables: Values, and tables of values.

    Raises:
        ConfigError: A key or value does not fit.
    """
    return validated(Preset, merged(values(preset), tables), source="preset")


def dump(preset: Preset) -> str:
    """Return the preset as JSON."""
    return TypeAdapter(Preset).dump_json(preset).decode()


def merged(below: dict[str, Any], above: dict[str, Any]) -> dict[str, Any]:
    """Return ``below`` with the values of ``above`` on top, table by table."""
    deep = {k: merged(below[k], v) for k, v in above.items() if isinstance(v, dict) and isinstance(below.get(k), dict)}
    return {**below, **above, **deep}
