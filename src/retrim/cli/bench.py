"""``retrim bench``: measure run times."""

import threading
from collections.abc import Callable
from pathlib import Path

from ..bench.measure import bench as measure
from ..bench.workloads import WORKLOADS
from ..runkit.run import Run
from .console import RichReporter, report_start, show_paths


def bench(works: tuple[str, ...] = tuple(WORKLOADS), out: Path | None = None) -> Callable[[threading.Event], int]:
    """Measure the run times of the paper's and this project's workloads, each in its own process.

    Args:
        works: Workloads to measure; by default, all.
        out: Folder for bench.json and bench.md; by default, a new one under runs/.
    """

    def execute(stop: threading.Event) -> int:
        run = report_start(Run("bench", out, stop=stop))
        fine = measure(run, RichReporter(), works=works)
        show_paths([run.folder / "bench.md"])
        return run.exit_code or int(not fine)

    return execute
