"""Writes recordings for external viewers, in the format that the file suffix gives."""

import os
from collections.abc import Callable, Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

from ...errors import ConfigError
from .recording import Recording, write_mcap
from .rerun_file import write_rrd


class Viewer(NamedTuple):
    """A recording format."""

    write: Callable[[Path, Recording], None]
    package: str
    """Import name of the package that writes the format."""
    install: str
    """Name of the package in the package index."""


VIEWERS: Mapping[str, Viewer] = {
    ".mcap": Viewer(write_mcap, "rosbags", "rosbags"),
    ".rrd": Viewer(write_rrd, "rerun", "rerun-sdk"),
}


def check_recording(path: Path | None) -> None:
    """Check a recording's file before a flight; None means that there is no recording.

    Raises:
        ConfigError: The file cannot be written, or the package that writes it is not installed.
    """
    if path is None:
        return
    viewer = VIEWERS.get(path.suffix)
    if viewer is None:
        raise ConfigError(f"--record {path}: the name must end with {' or '.join(VIEWERS)}")
    if not can_record(path):
        raise ConfigError(f"--record {path} needs {viewer.package}: pip install {viewer.install}")
    if path.is_dir():
        raise ConfigError(f"--record {path}: it is a folder")
    if not path.parent.is_dir() or not os.access(path.parent, os.W_OK):
        raise ConfigError(f"--record {path}: files cannot be written to {path.parent}")


def can_record(path: Path) -> bool:
    """Return whether the package that writes a recording with this suffix is installed."""
    return find_spec(VIEWERS[path.suffix].package) is not None


def record(path: Path, flight: Recording) -> None:
    """Write a flight in the format that the file suffix gives; the file appears once it is complete."""
    VIEWERS[path.suffix].write(path, flight)
