"""Each work of the bench in a process of its own, and the document of all."""

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ..errors import ConfigError
from ..experiments.reporter import Reporter
from ..experiments.run import Run
from ..experiments.tables.document import Document, TableSection
from .works import WORKS

COLUMNS = ("work", "run, s", "compile, s", "goal", "paper", "peak, MB", "remarks")
INTRO = """\
Made by `retrim bench`. Each work runs in a process of its own, from an empty compile cache unless the work says
otherwise. run: median of the runs. paper: reported for an RTX 4090. peak: memory of the process, JAX included."""


def bench(run: Run, reporter: Reporter, *, works: Sequence[str] = tuple(WORKS)) -> bool:
    """Time works, and write ``bench.md`` and ``bench.json``.

    Returns:
        Whether all of them ran.

    Raises:
        ConfigError: There is no such work.
    """
    if unknown := [name for name in works if name not in WORKS]:
        raise ConfigError(f"no work {', '.join(unknown)}; there are {', '.join(WORKS)}")
    rows, failed = list[dict[str, Any]](), False
    with tempfile.TemporaryDirectory() as cache, reporter.progress("bench") as advance:
        for i, name in enumerate(works):
            advance(i / len(works), WORKS[name].title)
            try:
                if name == "programs-warm" and not any(Path(cache).iterdir()):
                    _measured("programs-cold", Path(cache))
                rows.append(_measured(name, Path(cache)))
            except KeyboardInterrupt:
                run.stop.set()
            except OSError as error:
                failed = True
                reporter.say(f"{name}: {error}")
            if run.interrupted:
                break
    document = Document(run, "bench", "Bench", INTRO, [0], reporter)
    document.add(TableSection(COLUMNS, tuple(_cells(row) for row in rows)), rows)
    return not failed


def _cells(row: dict[str, Any]) -> tuple[str, ...]:
    times = _seconds(row["run_s"]), _seconds(row["compile_s"])
    return row["work"], *times, row["goal"], row["paper"], f"{row['peak_mb']:.0f}", row["remarks"]


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
        [sys.executable, "-m", "retrim.bench.works", name],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    if ran.returncode:
        raise OSError(f"failed: {ran.stderr.strip().splitlines()[-1:]}")
    return {"name": name, **json.loads(ran.stdout.splitlines()[-1])}


def _seconds(value: float | None) -> str:
    return "-" if value is None else f"{value:.3g}" if value < 10 else f"{value:.1f}"
