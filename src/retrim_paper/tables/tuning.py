"""Finds settings of the classical baselines by random search, on conditions that are not part of any table."""

import contextlib
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from jax import random

from retrim.config.baselines import baseline_request
from retrim.config.limits import check_flights, check_seeds
from retrim.config.loading import load
from retrim.config.methods import MethodRequest
from retrim.config.scenario import Scenario
from retrim.config.setup import Setup
from retrim.control.baselines import BASELINES, Baseline, Settings
from retrim.errors import ConfigError
from retrim.plants.sim import SimPlant
from retrim.runkit.document import Document, TableSection
from retrim.runkit.flights import FlightSpec
from retrim.runkit.flying import cut_at_termination, score_flight
from retrim.runkit.reporter import Reporter
from retrim.runkit.run import Run
from retrim.runtime.flight import FlightStopped
from retrim.runtime.pilot import ControllerPilot
from retrim.runtime.together import fly_together

Shown = Literal["state", "keypoints"]
CONDITIONS: dict[Shown, tuple[tuple[str, str, str, str | None], ...]] = {
    "state": (
        ("hover/retrim", "push=1.2", "onboard", None),
        ("hover/retrim", "gusts=3+step=-1.5", "ideal", None),
        ("track/retrim", "wind=5+push=-0.8", "onboard", "figure8"),
    ),
    "keypoints": (
        ("vision/retrim", "push=1.2", "onboard", None),
        ("vision/retrim", "gusts=3+step=-1.5", "ideal", None),
        ("vision/retrim", "push=-1.8", "ideal", None),
    ),
}
"""Conditions by controller input: preset (for the task and the declared lag), disturbance, sensors and reference."""
VIEWS = {"state": "the measured state", "keypoints": "the pose that a filter estimates from keypoints"}
CRASH = 1.0  # [m], error assigned to a crashed flight in the score
SETTLING = 3.0  # [s], initial part of a flight that does not count


def tuning(
    run: Run,
    reporter: Reporter,
    *,
    methods: tuple[str, ...] = tuple(BASELINES),
    shown: Shown = "state",
    candidates: int = 96,
    starts: int = 2,
    seconds: float = 12.0,
    seed: int = 100,
    plant: str = "bem",
) -> None:
    """Settings of the classical baselines: the best of random candidates, on separate pushes, starts and seeds.

    Args:
        run: Folder for tuning.md and tuning.json; the names contain the controllers' input unless it is the state.
        reporter: Receives progress and the sections.
        methods: Baselines to tune.
        shown: Input of the controllers: the measured state, or the pose estimated by a filter from keypoints.
        candidates: Number of settings to try for each baseline, in addition to the present ones; MPPI tries a third.
        starts: Flights per candidate and condition.
        seconds: Length of a flight [s]; the first 3 s do not count.
        seed: Seed for candidates, starts and gusts.
        plant: Plant for the flights; bem or simple.
    """
    check_seeds([seed])
    check_flights(starts, seconds)
    if seconds < SETTLING + 1.0:
        raise ConfigError(
            f"--seconds {seconds:g} must be at least {SETTLING + 1.0:g}: the first {SETTLING:g} do not count"
        )
    if not 0 <= candidates <= 10_000:
        raise ConfigError(f"--candidates {candidates} must be between 0 and 10000")
    if unknown := [name for name in methods if name not in BASELINES]:
        raise ConfigError(f"{', '.join(unknown)}: no baseline with settings; there are {', '.join(BASELINES)}")
    conditions = CONDITIONS[shown]
    lines = "; ".join(
        f"{preset.partition('/')[0]}{f' ({reference})' if reference else ''}, {disturbance_name}, sensors {sensors}"
        for preset, disturbance_name, sensors, reference in conditions
    )
    intro = (
        f"Made by `retrim reproduce tuning --shown {shown}`. {candidates} candidates for each method (a third for "
        "MPPI), drawn evenly in the logarithm of each range, and the present settings, fly the small quadrotor on "
        f"plant `{plant}` by {VIEWS[shown]}, from {starts} starts (seed {seed}) under: {lines}. The score is the root "
        f"mean square of the error after {SETTLING:g} s, the mean over flights [m], where a crash counts as "
        f"{CRASH:g} m. No table flies these conditions, starts or seeds."
    )
    stem = "tuning" if shown == "state" else f"tuning_{shown}"
    document = Document(run, stem, "Settings of the baselines", intro, [], reporter)
    setups = [Setup.from_preset(load(preset), reference) for preset, *_, reference in conditions]
    for name in methods:
        if run.interrupted:
            break
        baseline = BASELINES[name]
        settings_list = [
            dict(baseline.settings_for(setups[0].flight_task)),
            *_draw_candidates(baseline, -(-candidates // baseline.cost), seed),
        ]
        with contextlib.suppress(FlightStopped), run.interruptible(), reporter.progress(name) as advance:
            scores = np.zeros(len(settings_list))
            for i, (setup, (_, disturbance_name, sensors, reference)) in enumerate(
                zip(setups, conditions, strict=True)
            ):
                scenario = Scenario(disturbance_name, plant, sensors=sensors, reference=reference)
                advance(i / len(conditions), f"condition {i + 1} of {len(conditions)}")
                result = _fly_candidates(
                    baseline, settings_list, setup, scenario, starts=starts, seconds=seconds, seed=seed, stop=run.stop
                )
                scores += np.array(result) / len(conditions)
            document.add(_section(name, settings_list, scores), _rows(name, settings_list, scores))
    document.write()


def _draw_candidates(baseline: Baseline, n: int, seed: int) -> list[Settings]:
    """Return random candidates, which depend only on the baseline, their number and the seed."""
    low, high = np.array(list(baseline.ranges.values())).T
    shares = np.asarray(random.uniform(random.key(seed), (n, len(low))))
    values = low * (high / low) ** shares
    return [dict(zip(baseline.ranges, row, strict=True)) for row in values.tolist()]


def _fly_candidates(
    baseline: Baseline,
    settings_list: Sequence[Settings],
    setup: Setup,
    scenario: Scenario,
    *,
    starts: int,
    seconds: float,
    seed: int,
    stop: Any,
) -> list[float]:
    """Return the score of each candidate; all candidates fly as one batch."""
    specs = [FlightSpec(scenario, "base", start, seed) for start in range(starts)]
    start_states, dt = setup.flight_starts(starts, seed), setup.preset.dt
    all_plants = [scenario.make("small", dt=dt, seed=spec.plant_seed) for _ in settings_list for spec in specs]
    plants = [each for each in all_plants if isinstance(each, SimPlant)]
    if len(plants) < len(all_plants):
        raise ConfigError(f"plant {scenario.plant!r}: candidates are flown as one batch, which bem and simple can be")
    pilots = [
        ControllerPilot(
            MethodRequest(setup, None).by_state(baseline.make(baseline_request(setup, spec.key()), settings))
        )
        for settings in settings_list
        for spec in specs
    ]
    logs = fly_together(plants, pilots, start_states * len(settings_list), ticks=round(seconds / dt), stop=stop)
    flights = [score_flight(setup, specs[0], cut_at_termination(setup.flight_task, log)) for log in logs]
    errors = [
        CRASH if flight.log.terminated else float(np.sqrt(np.mean(flight.error[flight.log.t > SETTLING] ** 2)))
        for flight in flights
    ]
    means: list[float] = np.reshape(errors, (len(settings_list), starts)).mean(axis=1).tolist()
    return means


def _rows(name: str, settings_list: Sequence[Settings], scores: np.ndarray) -> list[dict[str, Any]]:
    scored_ones = zip(settings_list, scores.tolist(), strict=True)
    return [{"method": name, "settings": dict(settings), "score": score} for settings, score in scored_ones]


def _section(name: str, settings_list: Sequence[Settings], scores: np.ndarray) -> TableSection:
    """Return a table of the present settings and the best three."""
    best = [int(i) for i in np.argsort(scores)[:3]]
    columns = ("settings", *settings_list[0], "score [m]")
    selection = [("present", 0), *((f"{'best' if k == 0 else f'{k + 1}.'}", i) for k, i in enumerate(best))]
    lines = tuple((word, *(f"{v:.3g}" for v in settings_list[i].values()), f"{scores[i]:.4f}") for word, i in selection)
    return TableSection(columns, lines, BASELINES[name].label)
