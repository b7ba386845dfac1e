"""``retrim bench``: how long each piece of work takes on this machine, and how much memory."""

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.table import Table

from .bench_works import WORKS
from .session import Stopwatch, commit, console, machine, run_folder, write_results

HEADINGS = ("work", "run, s", "compile, s", "goal", "paper", "authors' code", "peak, MB", "remarks")
CAPTION = (
    "run: median of the runs. paper: reported for an RTX 4090. authors' code: measured on two CPU cores, compiling in "
    "brackets. peak: memory of the process, jax included."
)


def bench(works: tuple[str, ...] = tuple(WORKS), out: Path | None = None) -> int:
    """Time the work of the paper's runtime study and of this project, each in a process of its own.

    Compiling is measured apart, from an empty cache unless the work says otherwise. run_s is the median of the runs.

    Args:
        works: Which; all by default.
        out: Folder for results.json and bench.md; a new one under runs/ by default.
    """
    unknown = [name for name in works if name not in WORKS]
    if unknown:
        console.print(f"[bold red]retrim:[/] no work {', '.join(unknown)}; there are {', '.join(WORKS)}")
        return 2
    watch, rows, interrupted, failed = Stopwatch(), list[dict[str, Any]](), False, False
    shown = Table(title="retrim bench", caption=CAPTION)
    for heading in HEADINGS[:-1]:
        shown.add_column(heading, overflow="fold", min_width=24 if heading == "work" else None)
    with tempfile.TemporaryDirectory() as cache:
        for name in works:
            try:
                with console.status(f"{name}: {WORKS[name].title} ..."):
                    if name == "programs-warm" and not any(Path(cache).iterdir()):
                        _measured("programs-cold", Path(cache))
                    row = _measured(name, Path(cache))
            except KeyboardInterrupt:
                interrupted = True
                break
            except OSError as error:
                failed = True
                console.print(f"[bold red]{name}:[/] {error}")
                continue
            rows.append(row)
            shown.add_row(*_cells(row)[:-1])
            console.print(f"{row['work']}: run {_seconds(row['run_s'])} s ({row['remarks']})", soft_wrap=True)
    console.print(shown)
    folder = run_folder(out, "bench")
    path = write_results(folder, seeds=[0], watch=watch, rows=rows, interrupted=interrupted)
    (folder / "bench.md").write_text(markdown(rows, commit(), machine()))
    console.print(f"[bold]{path}[/]", soft_wrap=True)
    return 130 if interrupted else int(failed)


def markdown(rows: Sequence[dict[str, Any]], commit: str, machine: str) -> str:
    """The table as a document."""
    lines = [
        "# Bench",
        "",
        "Made by `retrim bench`. Each work in a process of its own, from an empty compile cache unless the",
    ]
    lines += [f"work says otherwise. {CAPTION}", "", f"Commit {commit}; {machine}.", ""]
    lines += ["| " + " | ".join(HEADINGS) + " |", "|" + "---|" * len(HEADINGS)]
    lines += ["| " + " | ".join(_cells(row)) + " |" for row in rows]
    return "\n".join([*lines, ""])


def _cells(row: dict[str, Any]) -> list[str]:
    times = _seconds(row["run_s"]), _seconds(row["compile_s"])
    return [row["work"], *times, row["goal"], row["paper"], row["authors"], f"{row['peak_mb']:.0f}", row["remarks"]]


def _measured(name: str, cache: Path) -> dict[str, Any]:
    """The row of one work, done by a fresh interpreter; ``cache`` starts empty, for the works that ask for one."""
    environment = {**os.environ, "RETRIM_COMPILE_CACHE": "0", "TF_CPP_MIN_LOG_LEVEL": "3"}
    environment.pop("JAX_COMPILATION_CACHE_DIR", None)
    if WORKS[name].cached:
        environment |= {
            "JAX_COMPILATION_CACHE_DIR": str(cache),
            "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        }
    ran = subprocess.run(
        [sys.executable, "-m", "retrim.cli.bench_works", name], env=environment, capture_output=True, text=True
    )
    if ran.returncode:
        raise OSError(f"bench {name} failed: {ran.stderr.strip().splitlines()[-1:]}")
    return {"name": name, **json.loads(ran.stdout.splitlines()[-1])}


def _seconds(value: float | None) -> str:
    return "-" if value is None else f"{value:.3g}" if value < 10 else f"{value:.1f}"
