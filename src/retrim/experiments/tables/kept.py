"""Sections that a run has finished are kept in its folder: the same command goes on where it was killed."""

import dataclasses
import hashlib
import json
import sys
from pathlib import Path
from typing import Any

from ..provenance import is_committed
from ..run import Run
from .document import TableSection

FOLDER = "sections"


def keep(run: Run, key: str, section: TableSection, rows: list[dict[str, Any]]) -> None:
    """Write a section and the rows behind it to the folder of the run."""
    whole = dataclasses.asdict(section) | {"picture": None if section.picture is None else section.picture.name}
    run.write_text(f"{FOLDER}/{key}.json", json.dumps({"section": whole, "rows": rows}) + "\n")


def kept(run: Run, key: str) -> tuple[TableSection, list[dict[str, Any]]] | None:
    """Return a section that an earlier run of this folder has finished, with its rows; None if there is none.

    Local changes to the code are told by nothing but ``-dirty``, so that with them nothing counts as finished.
    """
    path = run.folder / FOLDER / f"{key}.json"
    if not (is_committed() and path.is_file()):
        return None
    try:
        found = json.loads(path.read_text())
        whole, rows = found["section"], found["rows"]
        picture = None if whole["picture"] is None else run.folder / whole["picture"]
        lines = tuple(tuple(row) for row in whole["rows"])
        section = TableSection(tuple(whole["columns"]), lines, whole["title"], whole["about"], picture)
    except (OSError, ValueError, KeyError, TypeError):
        return None  # it is made again
    return None if picture is not None and not picture.is_file() else (section, rows)


def files_behind(*names: str | None) -> dict[str, str]:
    """Return digests of the files that stand behind names: of CSV files, and of the modules of ``module:name``.

    Args:
        *names: Of anything, sums of them too. Modules that they name have been imported.
    """
    found = dict[str, str]()
    for part in (part for name in names if name for part in name.split("+")):
        head = part.partition(":")[0].partition("=")[0]
        path = Path(getattr(sys.modules.get(head) if ":" in part else None, "__file__", None) or head)
        if path.is_file():
            found[part] = hashlib.sha256(path.read_bytes()).hexdigest()[:16]
    return found
