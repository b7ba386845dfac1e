"""Writes the files of a replay that are not its report, and removes those of an earlier replay."""

from collections.abc import Collection
from pathlib import Path

from ..config.names import plain_from
from ..config.setup import Setup
from ..config.vehicle_file import read_vehicle
from ..errors import ConfigError
from ..runkit.document import Document, TableSection
from .identification import IdentifiedVehicle
from .vehicle import vehicle_toml

REPORT = "replay.json"
OUTPUTS = ("replay.md", "replay.png", "replay.svg", "vehicle.toml", "adapted.safetensors", "delta.safetensors",
           "learner_state.safetensors", REPORT)  # fmt: skip


def clear_outputs(folder: Path, keep: Collection[Path] = ()) -> None:
    """Remove the files of an earlier replay from a folder, so that all files there belong to one log.

    Args:
        folder: The folder; if it has no report of a replay, its files are not those of a replay, and stay.
        keep: Files that this replay reads, which also stay.
    """
    if not (folder / REPORT).is_file():
        return
    inputs = {path.resolve() for path in keep}
    for name in OUTPUTS:
        if (path := folder / name).resolve() not in inputs:
            path.unlink(missing_ok=True)


def write_vehicle(
    document: Document, identification: IdentifiedVehicle, setup: Setup, log: str, *, remark: str = ""
) -> None:
    """Write ``vehicle.toml``; if the vehicle cannot fly, report the reason.

    Args:
        document: Report that receives the reason.
        identification: The identified parameters.
        setup: Set-up with the vehicle for the values that are not identified.
        log: Name of the log.
        remark: A further sentence for the comment at the beginning of the file.
    """
    text = vehicle_toml(identification, setup.preset.vehicle, plain_from(log), remark=remark)
    path = document.run.write_text("vehicle.toml", text)
    document.files.append(path)
    if reason := refusal_of(path):
        about = f"**The vehicle of vehicle.toml cannot fly, and `retrim pretrain` refuses it**: {reason}"
        document.add(TableSection((), (), "", about))


def refusal_of(path: Path) -> str:
    """Return the reason, in one line, for which the vehicle of a file cannot fly; empty if it can."""
    try:
        read_vehicle(path)
    except ConfigError as error:
        return str(error).removeprefix(f"{path}: ")
    return ""
