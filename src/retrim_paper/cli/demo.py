"""The command ``retrim demo``: pretraining, flight and adaptation in a minute."""

import sys
import threading
import webbrowser
from collections.abc import Callable
from pathlib import Path

from retrim.cli.console import RichReporter, console, report_start, show_paths, show_table
from retrim.runkit.run import INTERRUPTED, Run

from ..demo import demonstrate


def demo(
    preset: str = "hover/retrim",
    plant: str = "simple",
    seconds: float = 20.0,
    starts: int = 8,
    seed: int = 0,
    slow: bool = True,
    gif: bool = False,
    out: Path | None = None,
) -> Callable[[threading.Event], int]:
    """Pretrain a hover policy, push it, re-train it in flight, and fly a second, unknown quadrotor.

    Args:
        preset: hover/retrim and hover/fast train in seconds; hover/paper and hover/released take about a minute.
        plant: simple has rotors with linear drag and is the fastest; bem has blade-element rotors; others are extras.
        seconds: Length of a flight.
        starts: Flights per disturbance and method, each from a different start.
        seed: Seed for training and flights.
        slow: Whether to fly the second quadrotor, which has a slow rate loop.
        gif: Whether to write an animation of the second quadrotor, slow_vehicle.gif.
        out: Folder for the policy, results.json and the pictures; by default a new folder under runs/.
    """

    def execute(stop: threading.Event) -> int:
        run = report_start(Run("demo", out, stop=stop))
        result = demonstrate(
            preset, plant, run, RichReporter(), seconds=seconds, starts=starts, seed=seed, slow=slow, gif=gif
        )
        if result is None:
            return INTERRUPTED
        for table in result.tables:
            show_table(table)
        console.print(run.watch.sentence())
        show_paths(result.pictures)
        if result.best in result.pictures and sys.stdout.isatty():
            webbrowser.open(result.best.resolve().as_uri())
        return run.exit_code

    return execute
