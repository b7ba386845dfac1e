"""Reads named maps for logs from retrim and common autopilots, from TOML files in the folder ``maps``."""

import tomllib
from functools import cache
from importlib.resources import files
from pathlib import Path

from ...config.validation import read_toml, validate
from .body_map import BodyMap, is_body_map
from .log_map import LogMap

AnyMap = LogMap | BodyMap

USUAL_NAMES: dict[str, tuple[str, ...]] = {
    ".npz": ("retrim-npz",),
    ".csv": (
        "retrim-csv", "crazyflie", "crazyflie-quaternion", "crazyswarm", "crazyswarm-quaternion", "betaflight-csv",
    ),
    ".bbl": ("betaflight",),
    ".bin": ("ardupilot", "ardupilot-rates"),
    ".ulg": ("px4", "px4-1.9"),
    ".bag": ("mavros", "mavros-pose", "crazyswarm-ros"),
    ".mcap": ("retrim-mcap", "px4-dds", "px4-dds-1.13", "mavros", "mavros-pose", "crazyswarm-ros"),
}  # fmt: skip
"""Default maps by file suffix; the first one whose fields exist in the log is used."""
USUAL_NAMES |= {
    ".ulog": USUAL_NAMES[".ulg"],
    ".bfl": USUAL_NAMES[".bbl"],
    ".db3": USUAL_NAMES[".mcap"],
    "": USUAL_NAMES[".mcap"],
}


@cache
def names() -> tuple[str, ...]:
    """Return the names of all maps."""
    folder = files(__package__) / "maps"
    return tuple(sorted(each.name.removesuffix(".toml") for each in folder.iterdir() if each.name.endswith(".toml")))


def read_map(source: str | Path) -> AnyMap:
    """Return a map by name or from a TOML file; a map with measured rates and without states is a ``BodyMap``.

    Raises:
        ConfigError: The file cannot be read, or a value is missing, unknown or impossible.
    """
    if str(source) in names():
        tables = tomllib.loads((files(__package__) / "maps" / f"{source}.toml").read_text(encoding="utf-8"))
        name = f"map {source}"
    else:
        tables, name = read_toml(Path(source)), str(source)
    return validate(BodyMap, tables, source=name) if is_body_map(tables) else validate(LogMap, tables, source=name)
