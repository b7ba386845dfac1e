"""Makes all tables of the paper, one after another."""

from collections.abc import Callable, Sequence
from typing import Any

from retrim.errors import PlantError
from retrim.io.digests import file_digest
from retrim.runkit.codecs import json_codec
from retrim.runkit.document import Document, Link, TableSection
from retrim.runkit.provenance import section_key
from retrim.runkit.reporter import Reporter
from retrim.runkit.run import PARTS, Run

from .design import design
from .efficiency import efficiency
from .hover import hover
from .levels import METHODS
from .model import model
from .phase import phase
from .plants import plants
from .quick import QUICK, REMARK, Options
from .raptor import raptor
from .reversing import reversing
from .track import track
from .transfer import transfer
from .vision import vision

OURS = METHODS.index("full")
WITH_DATT = (*METHODS[:OURS], "datt", *METHODS[OURS:])
SEEDS: Options = {"seeds": (0, 1, 2)}
PLAN: tuple[tuple[Callable[..., None], str, Options], ...] = (
    (design, "Sec. IV-C", {}),
    (efficiency, "compute and samples", {}),
    (reversing, "Sec. IV-B.3", SEEDS),
    (model, "the plant", {}),
    (hover, "Table I", {**SEEDS, "presets": ("hover/retrim", "hover/paper"), "methods": WITH_DATT}),
    (vision, "Table III", {**SEEDS, "presets": ("vision/retrim",)}),
    (transfer, "Sec. IV-D", {"seconds": 24.0}),
    (phase, "Table II, the paper's formulation", {}),
    (plants, "other plants", {"starts": 4}),
    (raptor, "beside RAPTOR", {}),
    (track, "Table II", {"methods": WITH_DATT}),
)
"""Each table, its place in the paper, and its options. Timed tables come first, when the machine is least busy."""
QUICK_LEAVES_OUT = (phase, plants)
TABLE, TIME = json_codec("table"), json_codec("time", ".time.json")
"""Codecs for the time and page digest of a finished table, and for the time of an unfinished one."""
AT_LEAST = "at least "
"""Prefix for a time that excludes a killed run; the time of an interrupted run is recorded and counted."""


def everything(run: Run, reporter: Reporter, *, quick: bool = False) -> None:
    """All tables of the paper: an overview, and a folder for each; the same command resumes after a kill.

    Args:
        run: Folder for everything.md or everything_quick.md, with a subfolder for each table.
        reporter: Receives progress and the sections.
        quick: Use one seed, two starts and short flights, in a folder quick/; leave out the other plants and the
            paper's formulation of tracking.
    """
    run.remark = REMARK if quick else ""
    intro = f"Made by `retrim reproduce all{' --quick' if quick else ''}`."
    overview = f"everything{'_quick' * quick}"
    document = Document(run, overview, "The tables of the paper", intro, [], reporter)
    rows, store = list[dict[str, Any]](), run.store(reporter)
    for make, what, options in PLAN:
        if run.interrupted:
            break
        if quick and make in QUICK_LEAVES_OUT:
            continue
        name = make.__name__
        if quick:
            options = {**options, **QUICK.get(name, {})}
        folder = f"quick/{name}" if quick else name
        remark = run.remark if name in QUICK else ""
        row: dict[str, Any] = {"table": name, "what": what, "page": f"{folder}/{name}.md"}
        place = run.folder / folder
        part = Run("reproduce", place, stop=run.stop, remark=remark, policy_folder=run.folder, executor=run.executor)
        key = f"{PARTS}/{section_key(table=name, options=options)}"
        page = run.folder / row["page"]
        before = store.get(key, TABLE) if page.is_file() else None
        if before is not None and before.pop("page") == file_digest(page):
            run.reuse(name, reporter)
            row |= before
        else:
            took = store.get(key, TIME) or {"s": 0.0, "at_least": False}
            store.put(key, took | {"at_least": True}, TIME)  # overwritten or removed below unless this run is killed
            try:
                make(part, reporter, **options)
            except PlantError as error:
                store.remove(key, TIME)
                rows.append({"table": name, "what": what, "left_out": str(error)})
                continue
            took |= {"s": round(took["s"] + part.watch.total_s, 1)}
            row |= took
            if run.interrupted:
                store.put(key, took, TIME)
            else:
                store.remove(key, TIME)
                if page.is_file():  # the digest shows whether different code or options have overwritten the page
                    store.put(key, took | {"page": file_digest(page)}, TABLE)
        rows.append(row)
    lines = [
        (row["what"], f"{row['table']}, left out: {row['left_out']}", "-")
        if "left_out" in row
        else (row["what"], Link.to(row["page"], row["table"]), _minutes([row]))
        for row in rows
    ]
    lines.append(("", "together", _minutes([row for row in rows if "left_out" not in row])))
    document.add(TableSection(("of the paper", "table", "minutes"), tuple(lines)), rows)


def _minutes(rows: Sequence[dict[str, Any]]) -> str:
    """Return the total time of the tables [min]."""
    at_least = any(row["at_least"] for row in rows)
    return f"{AT_LEAST * at_least}{sum(row['s'] for row in rows) / 60:.1f}"
