"""Load presets by name and from TOML files, flags and JSON.

Every mistake in them raises an error with a one-line message.
"""

import dataclasses
import json
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from ..errors import ConfigError
from .named_presets import PRESETS
from .names import plain_from
from .presets import BUILT_IN_TASKS, Preset
from .renamed_keys import text_with_new_keys, with_new_keys
from .trust import check_trust
from .validation import read_toml, suggestion, validate
from .vehicle_file import VehicleSpec, read_vehicle
from .vehicles import vehicle_from


def load(name: str, overlay: Path | None = None, *, trust: Collection[str] = ()) -> Preset:
    """Return a preset.

    Args:
        name: Name, e.g. ``hover/fast``; ``PRESETS`` contains all names.
        overlay: TOML file with values that replace those of the preset.
        trust: Python names that the file may contain, e.g. ``mine:task``.

    Raises:
        ConfigError: There is no such preset, or the file cannot be used.
    """
    if name not in PRESETS:
        raise ConfigError(f"no preset {name!r}; {suggestion(name, PRESETS)}")
    return PRESETS[name] if overlay is None else overlaid(PRESETS[name], overlay, trust=trust)


def load_for(task: str, name: str) -> Preset:
    """Return a preset for a task.

    For the hover task, ``fast`` is short for ``hover/fast``. Custom tasks use the hover presets.

    Raises:
        ConfigError: The preset does not exist, or is for a different task.
    """
    preset = load(f"{task}/{name}" if f"{task}/{name}" in PRESETS else name)
    if preset.task == task:
        return preset
    if task in BUILT_IN_TASKS or preset.task != "hover":
        raise ConfigError(f"preset {preset.name!r} is for {preset.task}, not for {task}")
    return changed(preset, task=task, name=plain_from(f"{task} on {preset.name}"))


def overlaid(preset: Preset, overlay: Path, *, trust: Collection[str] = ()) -> Preset:
    """Return a preset with values replaced by those of a TOML file.

    Args:
        preset: Preset with the values to replace.
        overlay: TOML file; the path of a vehicle file in it is relative to the overlay's folder.
        trust: Python names that the file may contain, e.g. ``mine:task``.

    Raises:
        ConfigError: The file cannot be read, is not TOML, or has an invalid key or value, or an untrusted
            Python name.
    """
    above = with_new_keys(beside(read_toml(overlay), overlay.parent), source=str(overlay))
    whole = validate(Preset, merged(values(preset), above), source=str(overlay))
    check_trust(above, trust, source=str(overlay))
    return whole


def beside(above: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Return the values of a file, with the path of a vehicle file replaced by that vehicle file's content.

    Args:
        above: Values of the file.
        folder: Folder of the file, to which the path of a vehicle file is relative.

    Raises:
        ConfigError: The vehicle file cannot be used.
    """
    vehicle = above.get("vehicle")
    if not (isinstance(vehicle, str) and vehicle.endswith(".toml")):
        return above
    return {**above, "vehicle": dataclasses.asdict(read_vehicle(folder / vehicle))}


def with_vehicle(preset: Preset, vehicle: str | VehicleSpec) -> Preset:
    """Return a preset for a vehicle.

    The preset stores the content of a vehicle file, so the preset is self-contained.

    Raises:
        ConfigError: There is no such vehicle, or the vehicle file cannot be used.
    """
    result = vehicle_from(vehicle)
    return changed(preset, vehicle=dataclasses.asdict(result) if isinstance(result, VehicleSpec) else result)


def values(preset: Preset) -> dict[str, Any]:
    """Return the preset as plain dictionaries and numbers."""
    return dataclasses.asdict(preset)


def parse(text: str | bytes, *, source: str) -> Preset:
    """Return a preset from JSON, as the inverse of :func:`dump`.

    Callers that read the JSON from a file or a message must check all names (:func:`retrim.config.trust.check_trust`).

    Raises:
        ConfigError: The text is not a valid preset.
    """
    return validate(Preset, text_with_new_keys(text, source=source), source=source)


def missing_defaults(preset: Preset, text: str | bytes) -> dict[str, Any]:
    """Return, by dotted name, the values that are missing in a preset's JSON and therefore are this release's defaults.

    Args:
        preset: Result of :func:`parse` for the text.
        text: JSON of the preset.
    """
    return dict(_absent(values(preset), json.loads(text_with_new_keys(text, source="preset")), ""))


def _absent(whole: dict[str, Any], content: Any, before: str) -> Iterator[tuple[str, Any]]:
    for name, value in whole.items():
        if name not in content:
            yield before + name, value
        elif isinstance(value, dict) and isinstance(content[name], dict):
            yield from _absent(value, content[name], f"{before}{name}.")


def changed(preset: Preset, **tables: Any) -> Preset:
    """Return a preset with some values replaced, e.g. ``changed(preset, adapt={"num_updates": 5})``.

    Args:
        preset: Preset with the values to replace.
        **tables: New values, or tables of new values.

    Raises:
        ConfigError: A key or value is invalid.
    """
    return validate(Preset, merged(values(preset), tables), source="preset")


def dump(preset: Preset) -> str:
    """Return the preset as JSON."""
    return TypeAdapter(Preset).dump_json(preset).decode()


def merged(below: dict[str, Any], above: dict[str, Any]) -> dict[str, Any]:
    """Return ``below`` with values replaced by those of ``above``; nested tables are merged."""
    deep = {k: merged(below[k], v) for k, v in above.items() if isinstance(v, dict) and isinstance(below.get(k), dict)}
    return {**below, **above, **deep}
