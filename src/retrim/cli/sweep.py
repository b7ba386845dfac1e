"""``retrim sweep``: fly every combination of a sweep file."""

import threading
from collections.abc import Callable
from pathlib import Path

import tyro

from ..evaluation.cluster import join_cluster
from ..evaluation.sweep import read_sweep, run_sweep
from ..runkit.run import Run
from .console import RichReporter, Trust, show_paths


def sweep(
    file: tyro.conf.Positional[Path], out: Path | None = None, on: str | None = None, trust: Trust = ()
) -> Callable[[threading.Event], int]:
    """Fly every combination of a sweep file: presets x scenarios x methods x seeds.

    Policies and flight results are written to the folder while the sweep runs. After an interruption or a kill, the
    same command with the same --out continues the sweep.

    Args:
        file: TOML file with any of these keys: presets, seeds, methods, disturbances, plants, vehicles, sensors,
            references, starts, seconds, and a table [overlay] with values that replace those of the presets.
        on: tcp://HOST:PORT or tls://HOST:PORT of a Dask scheduler, whose workers run the training and the flights.
        trust: Python name that a file may contain, such as mine:task; its code is run. Repeat the option for each name.
        out: Folder for sweep.md, sweep.json and sweep.png; by default runs/sweep-NAME, named after the file.
    """

    def execute(stop: threading.Event) -> int:
        content, reporter = read_sweep(file, trust), RichReporter()
        with join_cluster(on, reporter) as executor:
            run = Run("sweep", out or Path("runs") / f"sweep-{file.stem}", stop=stop, executor=executor)
            run_sweep(content, run, reporter)
        show_paths([path for path in (run.folder / "sweep.md", run.folder / "sweep.png") if path.is_file()])
        return run.exit_code

    return execute
