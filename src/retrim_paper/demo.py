"""Demonstrates the whole loop in a minute: pretrain, push, adapt, and fly a second vehicle."""

from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from retrim.config.limits import check_flights, check_seeds
from retrim.config.loading import changed, load_for
from retrim.config.scenario import Scenario
from retrim.config.setup import Setup
from retrim.errors import ConfigError
from retrim.evaluation.figures import picture
from retrim.evaluation.metrics import rows
from retrim.evaluation.study import Study, fly_all
from retrim.runkit.document import TableSection
from retrim.runkit.interrupts import interrupts_only_set
from retrim.runkit.outputs import write_events, write_trained_policy
from retrim.runkit.reporter import Reporter
from retrim.runkit.run import Run
from retrim.runkit.training import nominal_error, train

from .slow_vehicle import UPDATES, fly_slow_vehicle
from .tables.hover import PAPER
from .tables.levels import LEVELS, level_table

REPORT_METHODS = ("base", "full")
MOST_STARTS = 4  # largest number of starts for the second quadrotor
REASONS = {
    "hover/retrim": "an observer answers within milliseconds; a closed-form residual and short updates follow",
    "hover/fast": "the paper's loop with a command delay in the model, trained in seconds",
    "hover/released": "the delay, observation and training size of the authors' code",
    "hover/paper": "as printed: no delay in the model, no past commands in the observation",
}


class Demonstration(NamedTuple):
    """Results of a demonstration."""

    tables: list[TableSection]
    pictures: list[Path]
    best: Path
    """Picture to look at first."""


def demonstrate(
    name: str,
    plant: str,
    run: Run,
    reporter: Reporter,
    *,
    seconds: float,
    starts: int,
    seed: int,
    slow: bool = True,
    gif: bool = False,
) -> Demonstration | None:
    """Pretrain a hover policy, fly it under unknown disturbances, and re-train it in flight.

    Then a policy for many vehicles flies a second quadrotor, whose rate loop is slow.

    Args:
        name: Preset for a hover policy.
        plant: Plant for the flights.
        run: Run whose folder receives the results.
        reporter: Receives lines and progress.
        seconds: Length of a flight.
        starts: Flights per disturbance and method.
        seed: Seed for training, starts and flights.
        slow: Whether to fly the second quadrotor.
        gif: Whether to write an animation of the second quadrotor.

    Returns:
        The tables and pictures; None if pretraining was interrupted.

    Raises:
        ConfigError: A name does not exist, or a size is out of range.
    """
    check_seeds([seed])
    check_flights(starts, seconds)
    if gif and not slow:
        raise ConfigError("the animation shows the second quadrotor; leave out --no-slow or --gif")
    preset = load_for("hover", name)
    scenario, setup = Scenario("large", plant=plant), Setup.from_preset(preset)
    count = len(LEVELS) * 2 * starts
    reporter.say(f"{count} flights of {seconds:g} s; about a minute on two cores with those of a second quadrotor")
    reporter.say(f"preset {preset.name}: {REASONS.get(preset.name, 'your choice')}")
    reporter.say(f"{scenario.vehicle_name(preset.vehicle)} quadrotor on plant {plant}: {scenario.entry.about}")
    policy, losses = train(setup, seed, reporter=reporter, stop=run.stop)
    if losses:
        write_trained_policy(run, setup, policy, losses, seed=seed)
    if run.interrupted:
        reporter.say(f"interrupted while pretraining, after {len(losses)} steps")
        return None
    study = Study(preset, {seed: policy}, (nominal_error(setup, policy),))
    reporter.say(f"hover error in its own model: {1000 * study.errors[0]:.1f} mm")
    scenarios = [replace(scenario, disturbance=level) for level in LEVELS]
    flights = fly_all(study, scenarios, run, reporter, starts=starts, seconds=seconds, keep=False).flights
    result: list[dict[str, Any]] = list(rows(flights))
    second = None
    if slow and not run.interrupted:
        family = changed(load_for("hover", "hover/any"), pretrain={"num_updates": UPDATES})
        second = fly_slow_vehicle(study, family, run, reporter, starts=min(starts, MOST_STARTS), seed=seed, gif=gif)
    result += [] if second is None else second.rows
    with interrupts_only_set(run.stop):
        run.write_results(result, seeds=[seed], preset=preset.name, losses=losses)
        write_events(flights, run.folder)
    title = f"hover error [m]: mean ± std over {starts} starts, last 2 s of {seconds:g} s; in brackets the paper's"
    table = level_table(result, REPORT_METHODS, {method: PAPER[method] for method in REPORT_METHODS}, title)
    pictures = [path for each in scenarios for path in picture(flights, setup, each, run.folder)]
    tables = [table] if second is None else [table, second.table]
    pictures += [] if second is None else second.pictures
    return Demonstration(tables, [path for path in pictures if path.suffix != ".svg"], run.folder / "hover_large.png")
