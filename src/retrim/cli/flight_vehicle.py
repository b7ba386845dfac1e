"""The option ``--save-vehicle`` of the commands that fly."""

from pathlib import Path

from ..config.setup import Setup
from ..errors import ConfigError, LogError
from ..experiments.flights import Flight
from ..io.files import write_whole
from ..replay.flight_vehicle import flight_vehicle_toml
from .console import refuse


def check_vehicle_file(path: Path | None) -> None:
    """Check the file of ``--save-vehicle`` before anything flies.

    Args:
        path: File to write; None for none.

    Raises:
        ConfigError: It is no TOML file, or its folder does not exist.
    """
    if path is None:
        return
    if path.suffix != ".toml":
        raise ConfigError(f"--save-vehicle {path}: a vehicle file must end in .toml")
    if not path.absolute().parent.is_dir():
        raise ConfigError(f"--save-vehicle {path}: folder {path.absolute().parent} does not exist; make it first")


def save_flight_vehicle(flight: Flight, setup: Setup, path: Path | None) -> tuple[list[Path], int]:
    """Write the vehicle that a flight shows; return the files that were written, and the exit code.

    Args:
        flight: The flight.
        setup: Set-up of the policy that flew.
        path: File to write; None for none.
    """
    if path is None:
        return [], 0
    try:
        write_whole(path, flight_vehicle_toml(flight.log, setup, path.stem).encode())
    except (LogError, OSError) as error:
        return [], refuse(f"--save-vehicle {path}: {error}")
    return [path], 0
