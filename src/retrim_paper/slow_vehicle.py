"""Flies the second part of the demonstration: a quadrotor with a 100 ms rate loop, unknown to the methods."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from retrim.config.methods import find_method
from retrim.config.presets import Preset
from retrim.config.scenario import Scenario
from retrim.config.setup import Setup
from retrim.evaluation.figures import animate, picture
from retrim.evaluation.metrics import metres, rows
from retrim.evaluation.study import Study, fly_all
from retrim.io.files import write_whole
from retrim.runkit.document import TableSection
from retrim.runkit.flights import Flight
from retrim.runkit.reporter import Reporter
from retrim.runkit.run import Run
from retrim.runkit.training import train

from .tables.hidden import PUSH_TIME
from .vehicles import DELAY, slow_quadrotor

UPDATES = 200  # a fifth of the preset's training: less agile, and trained in ten seconds
SECONDS = 10.0
PUSH = "early-step"  # 2 m/s^2 per axis from 4 s on
FIGURE = "One quadrotor with a rate loop of 100 ms, which no method knows"
LABELS = {"base": "policy for a faster vehicle", "indi": "INDI", "base-id": "policy for many vehicles"}


class Entrant(NamedTuple):
    """A method in the comparison."""

    study: Study
    method: str
    vehicle: str
    """Knowledge of the method about the vehicle."""


class SlowVehicle(NamedTuple):
    """Results of the comparison."""

    table: TableSection
    rows: list[dict[str, Any]]
    pictures: list[Path]


def fly_slow_vehicle(
    known_study: Study, family: Preset, run: Run, reporter: Reporter, *, starts: int, seed: int, gif: bool = False
) -> SlowVehicle | None:
    """Fly a quadrotor with a slow rate loop by a policy for a different vehicle, INDI, and a policy for many vehicles.

    Args:
        known_study: Policy for one vehicle.
        family: Preset for a policy for many vehicles, which is trained here.
        run: Run whose folder receives the picture.
        reporter: Receives lines and progress.
        starts: Flights per method.
        seed: Seed for training, starts and flights.
        gif: Whether to write an animation of the first flight of each method.

    Returns:
        The table, the rows and the pictures; None if the run was interrupted.
    """
    scenario = Scenario(PUSH, plant="second-order", vehicle=slow_quadrotor(), delay=DELAY)
    reporter.say(f"a second quadrotor: body rates lag by 100 ms, commands by {1000 * DELAY:.0f} ms; no method knows it")
    setup = Setup.from_preset(family)
    policy, _ = train(setup, seed, reporter=reporter, stop=run.stop)
    if run.interrupted:
        return None
    many = Study(family, {seed: policy}, ())
    informed_study = replace(known_study, preset=replace(known_study.preset, vehicle=slow_quadrotor()))
    entrants = (
        Entrant(known_study, "base", "not known"),
        Entrant(known_study, "indi", "not known"),
        Entrant(informed_study, "indi", "known"),
        Entrant(many, "base-id", "identified in flight"),
    )
    flights = [_fly(each, scenario, run, reporter, starts) for each in entrants]
    if run.interrupted or not all(flights):
        return None
    lines = [_line(each, own) for each, own in zip(entrants, flights, strict=True)]
    columns = ("method", "vehicle", "lost", "error, last 2 s [m]", "peak after the push [m]")
    title = f"One quadrotor with a rate loop of 100 ms, a push of 2 m/s² per axis at 4 s, {starts} starts"
    shown_flights = [
        flight for each, own in zip(entrants, flights, strict=True) if each.vehicle != "known" for flight in own
    ]
    pictures = picture(shown_flights, setup, scenario, run.folder, stem="slow_vehicle", title=FIGURE, labels=LABELS)
    if gif:
        reporter.say("drawing the animation")
        path = run.folder / "slow_vehicle.gif"
        write_whole(path, animate(shown_flights, setup, scenario, FIGURE, LABELS))
        pictures.append(path)
    result = [
        row | {"preset": each.study.preset.name, "vehicle_known": each.vehicle}
        for each, own in zip(entrants, flights, strict=True)
        for row in rows(own)
    ]
    return SlowVehicle(TableSection(columns, tuple(lines), title), result, pictures)


def _fly(each: Entrant, scenario: Scenario, run: Run, reporter: Reporter, starts: int) -> list[Flight]:
    return fly_all(
        each.study, [scenario], run, reporter, methods=(each.method,), starts=starts, seconds=SECONDS, keep=False
    ).flights


def _line(each: Entrant, flights: Sequence[Flight]) -> tuple[str, ...]:
    left = [flight for flight in flights if not flight.log.terminated]
    peak = metres(max(float(np.max(flight.error[flight.log.t >= PUSH_TIME])) for flight in left)) if left else "-"
    error = metres(float(np.mean([flight.steady for flight in left]))) if left else "-"
    label = find_method(each.method).label
    return label, each.vehicle, f"{len(flights) - len(left)} of {len(flights)}", error, peak
