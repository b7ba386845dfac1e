"""``retrim demo``: the whole loop in a minute."""

import sys
import threading
import webbrowser
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from ..config.loading import load_for
from ..config.scenario import Scenario
from ..config.setup import Setup
from ..experiments.figures import picture
from ..experiments.interrupts import interrupts_only_set
from ..experiments.limits import check_flights, check_seeds
from ..experiments.metrics import rows
from ..experiments.outputs import write_events, write_trained
from ..experiments.run import INTERRUPTED, Run
from ..experiments.tables.hover import PAPER
from ..experiments.tables.levels import LEVELS, level_table
from ..experiments.tables.study import Study, fly_all
from ..experiments.training import nominal_error, train
from .console import RichReporter, console, show_paths, show_table, started

SHOWN = ("base", "full")
WHY = {
    "hover/retrim": "felt gravity turns the frame in milliseconds, a closed-form residual and short bursts do the rest",
    "hover/fast": "the paper's loop with a command delay in the model, trained in seconds",
    "hover/released": "the delay, observation and training size of the authors' code",
    "hover/paper": "as printed: no delay in the model, no past commands in the observation",
}


def demo(
    preset: str = "hover/retrim",
    plant: str = "simple",
    seconds: float = 20.0,
    starts: int = 8,
    seed: int = 0,
    out: Path | None = None,
) -> Callable[[threading.Event], int]:
    """Pretrain a hover policy, push it with disturbances that it never saw, and re-train it while it flies.

    Args:
        preset: hover/retrim and hover/fast train in seconds; hover/paper and hover/released take about a minute.
        plant: simple: rotors with linear drag, the quickest; bem: blade-element rotors; the others are extras.
        seconds: Length of a flight.
        starts: Flights per disturbance and method, each from another start.
        seed: Seed of everything.
        out: Folder for the policy, results.json and the pictures; a new one under runs/ by default.
    """
    return lambda stop: _demo(preset, plant, seconds, starts, seed, out, stop)


def _demo(
    name: str, plant: str, seconds: float, starts: int, seed: int, out: Path | None, stop: threading.Event
) -> int:
    check_seeds([seed])
    check_flights(starts, seconds)
    preset = load_for("hover", name)
    scenario, setup, reporter = Scenario("large", plant=plant), Setup.of(preset), RichReporter()
    run = started(Run("demo", out, stop=stop))
    console.print(f"[bold]{len(LEVELS) * 2 * starts} flights of {seconds:g} s[/]; about a minute on two cores")
    console.print(f"preset [bold]{preset.name}[/]: {WHY.get(preset.name, 'your choice')}")
    console.print(
        f"{scenario.vehicle_name(preset.vehicle)} quadrotor on plant [bold]{plant}[/]: {scenario.entry.about}"
    )
    policy, losses = train(setup, seed, reporter=reporter, stop=stop)
    if losses:
        write_trained(run, setup, policy, losses, seed=seed)
    if run.interrupted:
        console.print(f"interrupted while pretraining, after {len(losses)} steps")
        return INTERRUPTED
    study = Study(preset, {seed: policy}, (nominal_error(setup, policy),))
    console.print(f"hover error in its own model: {1000 * study.errors[0]:.1f} mm")
    scenarios = [replace(scenario, disturbance=level) for level in LEVELS]
    flights = fly_all(study, scenarios, run, reporter, starts=starts, seconds=seconds).flown
    found = rows(flights)
    with interrupts_only_set(stop):
        run.write_results(found, seeds=[seed], preset=preset.name, losses=losses)
        write_events(flights, run.folder)
    title = f"hover error [m]: mean ± std over {starts} starts, last 2 s of {seconds:g} s; in brackets the paper's"
    show_table(level_table(found, SHOWN, {method: PAPER[method] for method in SHOWN}, title))
    console.print(run.watch.sentence())
    pictures = [path for each in scenarios for path in picture(flights, setup, each, run.folder)]
    show_paths([path for path in pictures if path.suffix == ".png"])
    best = run.folder / "hover_large.png"
    if best in pictures and sys.stdout.isatty():
        webbrowser.open(best.resolve().as_uri())
    return run.exit_code
