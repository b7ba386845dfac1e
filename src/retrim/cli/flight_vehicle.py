"""Implement the option ``--save-vehicle`` of the flight commands."""

from pathlib import Path

from ..config.setup import Setup
from ..errors import ConfigError, LogError
from ..io.files import write_whole
from ..replay.flight_vehicle import flight_vehicle_toml
from ..runkit.flights import Flight
from .console import refuse


def check_vehicle_file(path: Path | None) -> None:
    """Check the file of ``--save-vehicle`` before the flight.

    Args:
        path: File to write; None if the option is not given.

    Raises:
        ConfigError: The name does not end in .toml, or the folder does not exist.
    """
    if path is None:
        return
    if path.suffix != ".toml":
        raise ConfigError(f"--save-vehicle {path}: the name of a vehicle file must end with .toml")
    if not path.absolute().parent.is_dir():
        raise ConfigError(f"--save-vehicle {path}: folder {path.absolute().parent} does not exist; create it first")


def save_flight_vehicle(flight: Flight, setup: Setup, path: Path | None) -> tuple[list[Path], int]:
    """Write the vehicle identified from a flight; return the written files and the exit code.

    Args:
        flight: Flight to identify the vehicle from.
        setup: Set-up of the policy that flew.
        path: File to write; None if the option is not given.
    """
    if path is None:
        return [], 0
    try:
        write_whole(path, flight_vehicle_toml(flight.log, setup, path.stem).encode())
    except (LogError, OSError) as error:
        return [], refuse(f"--save-vehicle {path}: {error}")
    return [path], 0
