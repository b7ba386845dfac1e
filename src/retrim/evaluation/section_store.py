"""Stores a run's finished sections in its folder, so that the same command resumes after being killed."""

import dataclasses
import hashlib
import json
import sys
from pathlib import Path
from typing import Any

from ..config.presets import Preset
from ..config.scenario import Scenario
from ..runkit.document import TableSection
from ..runkit.run import PARTS, Run


def keep(run: Run, key: str, section: TableSection, rows: list[dict[str, Any]]) -> None:
    """Write a section and its rows to the run's folder."""
    drawn = None if section.picture is None else {section.picture.name: digest_of(section.picture)}
    whole = dataclasses.asdict(section) | {"picture": drawn}
    run.write_text(f"{PARTS}/{key}.json", json.dumps({"section": whole, "rows": rows}) + "\n")


def kept(run: Run, key: str) -> tuple[TableSection, list[dict[str, Any]]] | None:
    """Return a section that an earlier run has finished in this folder, with its rows; None if there is none.

    The result is also None if another run has overwritten the section's picture. The section is then made again.
    """
    path = run.folder / PARTS / f"{key}.json"
    if not path.is_file():
        return None
    try:
        result = json.loads(path.read_text())
        whole, rows = result["section"], result["rows"]
        drawn = {run.folder / name: digest for name, digest in (whole["picture"] or {}).items()}
        if any(digest_of(path) != digest for path, digest in drawn.items()):
            return None
        lines = tuple(tuple(row) for row in whole["rows"])
        section = TableSection(tuple(whole["columns"]), lines, whole["title"], whole["about"], next(iter(drawn), None))
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None  # the section is made again
    run.reused += 1
    return section, rows


def file_digests(*names: str | None) -> dict[str, str]:
    """Return digests of the files that names refer to: CSV files, and the modules in ``module:name``.

    Args:
        *names: Names of any kind, or several joined by ``+``. Their modules must have been imported.
    """
    result = dict[str, str]()
    for part in (part for name in names if name for part in name.split("+")):
        head = part.partition(":")[0].partition("=")[0]
        path = Path(getattr(sys.modules.get(head) if ":" in part else None, "__file__", None) or head)
        if path.is_file():
            result[part] = digest_of(path)
    return result


def named_in(preset: Preset) -> list[str | None]:
    """Return the names in a preset that may refer to a file."""
    trained_on = None if preset.track is None else preset.track.reference
    vehicle = preset.vehicle if isinstance(preset.vehicle, str) else None
    learning = (preset.adapt.residual, preset.adapt.learner, preset.adapt.optimiser, preset.pretrain.network)
    return [preset.task, *learning, trained_on, vehicle]


def named_by(scenario: Scenario) -> list[str | None]:
    """Return the names in a scenario that may refer to a file."""
    vehicle = scenario.vehicle if isinstance(scenario.vehicle, str) else None
    return [scenario.plant, scenario.sensors, scenario.disturbance, scenario.reference, vehicle]


def digest_of(path: Path) -> str:
    """Return a digest of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()[:16]
