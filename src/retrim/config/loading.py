"""Presets from names, TOML files, flags and JSON; every mistake is one clear line."""

import dataclasses
import difflib
import tomllib
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from ..errors import ConfigError
from .presets import BUILT_IN_TASKS, PRESETS, Preset
from .vehicle_file import read_vehicle

MAX_TOML_BYTES = 1_000_000


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
    return _validated(merged(values(preset), above), source=str(overlay))


def read_toml(path: Path) -> dict[str, Any]:
    """Return the tables of a TOML file.

    Raises:
        ConfigError: It is not a regular file, too large, or not TOML.
    """
    try:
        if not path.is_file():
            raise ConfigError(f"{path}: {'not a regular file' if path.exists() else 'no such file'}")
        if path.stat().st_size > MAX_TOML_BYTES:
            raise ConfigError(f"{path}: larger than the {MAX_TOML_BYTES} bytes that are accepted")
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except (UnicodeDecodeError, tomllib.TOMLDecodeError, RecursionError) as error:
        raise ConfigError(f"{path}: not TOML ({error})") from error
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror})") from error


def values(preset: Preset) -> dict[str, Any]:
    """Return the preset as plain dictionaries and numbers."""
    return dataclasses.asdict(preset)


def parse(text: str | bytes, *, source: str) -> Preset:
    """Return a preset from JSON, the inverse of :func:`dump`.

    Raises:
        ConfigError: It is not a preset.
    """
    try:
        return TypeAdapter(Preset).validate_json(text)
    except ValidationError as error:
        raise ConfigError(f"{source}: {_explained(error)}") from error


def changed(preset: Preset, **tables: Any) -> Preset:
    """Return a preset with some values replaced, as in ``changed(preset, adapt={"num_updates": 5})``.

    Args:
        preset: What lies below.
        **tables: Values, and tables of values.

    Raises:
        ConfigError: A key or value does not fit.
    """
    return _validated(merged(values(preset), tables), source="preset")


def dump(preset: Preset) -> str:
    """Return the preset as JSON."""
    return TypeAdapter(Preset).dump_json(preset).decode()


def merged(below: dict[str, Any], above: dict[str, Any]) -> dict[str, Any]:
    """Return ``below`` with the values of ``above`` on top, table by table."""
    deep = {k: merged(below[k], v) for k, v in above.items() if isinstance(v, dict) and isinstance(below.get(k), dict)}
    return {**below, **above, **deep}


def suggestion(name: str, known: Any) -> str:
    """Return the nearest known name, and all of them."""
    near = difflib.get_close_matches(name, list(known), n=1)
    return (f"did you mean {near[0]!r}? " if near else "") + f"there are {', '.join(known)}"


def _validated(tables: dict[str, Any], *, source: str) -> Preset:
    try:
        return TypeAdapter(Preset).validate_python(tables)
    except ValidationError as error:
        raise ConfigError(f"{source}: {_explained(error)}") from error


def _explained(error: ValidationError) -> str:
    """Each mistake with its path and, for an unknown key, the keys that there are."""
    found = dict[str, str]()
    for each in error.errors(include_url=False):
        path = [str(part) for part in each["loc"] if not str(part).startswith("function-")]
        where = ".".join(path) or "preset"
        message = each["msg"].removeprefix("Value error, ")
        if each["type"] == "unexpected_keyword_argument":
            keys = [field.name for field in dataclasses.fields(_table(path[:-1]))]
            message = f"unknown key; {suggestion(path[-1], keys)}"
        found.setdefault(where, message)
    return "; ".join(f"{where}: {message}" for where, message in found.items())


def _table(path: list[str]) -> Any:
    """The dataclass of a table of the preset."""
    from . import presets, vehicle_file

    tables = {
        "pretrain": presets.Pretrain,
        "adapt": presets.Adapt,
        "track": presets.Track,
        "vision": presets.Vision,
        "vehicle": vehicle_file.VehicleSpec,
    }
    return tables.get(path[0], Preset) if path else Preset
