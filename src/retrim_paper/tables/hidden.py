"""Flies the gauntlet of hidden vehicles: one policy for many unknown vehicles."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from retrim.config.hidden_vehicles import HiddenVehicle, draw_vehicles
from retrim.config.limits import check_flights, check_seeds
from retrim.config.loading import load_for
from retrim.config.methods import find_method
from retrim.config.scenario import Scenario
from retrim.errors import ConfigError
from retrim.evaluation.flight_groups import clear_flights
from retrim.evaluation.metrics import metres
from retrim.evaluation.study import Study, fly_all, refuse_misfits, train_all
from retrim.runkit.document import Document, TableSection
from retrim.runkit.flights import Flight
from retrim.runkit.recovery import recoveries
from retrim.runkit.reporter import Reporter
from retrim.runkit.run import Run
from retrim.viz import plots
from retrim.viz.vehicle_map import vehicle_map

from .hidden_entrants import KNOWLEDGE, Entrant

MOST_VEHICLES = 10_000
PUSH_TIME = 4.0  # [s], time of the push at hover
SCORE_DELAY = 5.0  # [s], time after the push from which the error is scored for one second
FULL_SPEED_TIME = 5.0  # [s], time from which tracking errors are scored; the reference has its full speed by then
INTRO = """\
Made by `retrim gauntlet --vehicles hidden{option}`: {count} vehicles, drawn from one size factor (seed {seed}), from
30 g to 3 kg: lag of the body rates 15 to 150 ms (second order, damping ratio 0.4 to 1.2), command delay 0 to 60 ms,
thrust lag 10 to 80 ms, thrust gain 0.6 to 1.6, and at full command 1.4 times the weight or more. Plant `second-order`,
{sensors} sensors. Vehicle "not known": the method receives no vehicle file. "wrong by up to two": it receives a file
with a random error of up to a factor of two in the mass, inertia, thrust, damping, delay and each lag. "known": it
receives the true values, but not the thrust gain. "known, own policy": in addition, a policy is trained for each
vehicle. MPPI and these policies fly each vehicle once, since they compute for a long time. lost: flights that left the
bounds. {metrics} Cells: median over all flights, 95th percentile, and worst; a lost flight counts as infinite (∞)."""


@dataclass(frozen=True)
class Course:
    """A flight that every vehicle flies."""

    title: str
    stem: str
    """File name of the figure."""
    disturbance: str
    seconds: float
    reference: str | None = None


@dataclass(frozen=True)
class Scoring:
    """Scores of a flight; the first one colours the map."""

    columns: Mapping[str, str]
    """Column heading for each score, by its name."""
    score: Callable[[Flight], Mapping[str, float]]
    colour: str
    """Label for the colour scale."""
    about: str


def _hover_scores(flight: Flight) -> dict[str, float]:
    t, error, is_lost = flight.log.t, flight.error, flight.log.terminated
    return {
        "error_m": np.inf if is_lost else float(np.mean(error[t >= PUSH_TIME + SCORE_DELAY - 1e-6])),
        "to_10cm_s": recoveries(t, error, [PUSH_TIME], 0.1, terminated=is_lost)[0],
        "to_2cm_s": recoveries(t, error, [PUSH_TIME], 0.02, terminated=is_lost)[0],
        "peak_m": np.inf if is_lost else float(np.max(error[t >= PUSH_TIME])),
    }


def _track_scores(flight: Flight) -> dict[str, float]:
    if flight.log.terminated:
        return {"rmse_m": np.inf, "peak_m": np.inf}
    error = flight.error[flight.log.t >= FULL_SPEED_TIME]
    return {"rmse_m": float(np.sqrt(np.mean(error**2))), "peak_m": float(np.max(error))}


HOVER = Course("Hover, a push of 2 m/s² per axis at 4 s", "hidden", "early-step", PUSH_TIME + SCORE_DELAY + 1.0)
COURSES: dict[str, tuple[Course, ...]] = {
    "hover": (HOVER,),
    "track": (
        Course("Figure-8 of 10 s", "hidden_10s", "none", 25.0, "lissajous=0.8886"),
        Course("Figure-8 of 5.5 s", "hidden_5.5s", "none", 25.0, "lissajous"),
    ),
}
SCORINGS = {
    "hover": Scoring(
        {"error_m": "error [m]", "to_10cm_s": "to 10 cm [s]", "to_2cm_s": "to 2 cm [s]", "peak_m": "peak [m]"},
        _hover_scores,
        "error 5 s after the push [m], worst flight",
        "error: mean from 5 to 6 s after the push. to 10 cm, to 2 cm: time after the push until the error stays below; "
        "infinite if it never does. peak: largest error after the push.",
    ),
    "track": Scoring(
        {"rmse_m": "RMSE [m]", "peak_m": "peak [m]"},
        _track_scores,
        "root mean square error [m], worst flight",
        "Figure-8 of 2 m x 1 m, without a disturbance. RMSE: root mean square error from 5 s on, and its mean over the "
        "flights that were not lost. peak: largest error from 5 s on.",
    ),
}


def fly_hidden(
    run: Run,
    reporter: Reporter,
    *,
    task: str,
    entrants: Sequence[Entrant],
    count: int,
    draw: int,
    seeds: tuple[int, ...],
    starts: int,
    sensors: str,
) -> None:
    """Fly hidden vehicles and write ``hidden.md``, ``results.json`` and a map for each course.

    Args:
        run: Folder for the results.
        reporter: Receives progress and the tables.
        task: Task of the entrants: hover or track.
        entrants: Presets and methods.
        count: Number of vehicles.
        draw: Seed from which the vehicles are drawn.
        seeds: Training seeds.
        starts: Flights per vehicle, method and training seed.
        sensors: Name of a sensor model.

    Raises:
        ConfigError: A name does not exist, or the parts are incompatible; raised before any training.
    """
    if not 1 <= count <= MOST_VEHICLES:
        raise ConfigError(f"count must be 1 to {MOST_VEHICLES} vehicles, got {count}")
    courses, scoring = COURSES[task], SCORINGS[task]
    check_seeds(seeds)
    check_flights(starts, courses[0].seconds)
    vehicles = draw_vehicles(count, draw)
    presets = {name: load_for(task, name) for name in dict.fromkeys(each.preset for each in entrants)}
    for entrant in entrants:
        first = [_scenario(course, vehicles[0], sensors) for course in courses]
        methods = (entrant.method,)
        refuse_misfits(presets[entrant.preset], first, methods=methods, starts=starts, seconds=courses[0].seconds)
    option = "" if task == "hover" else f" --preset {task}/retrim"
    intro = INTRO.format(count=count, seed=draw, sensors=sensors, option=option, metrics=scoring.about)
    document = Document(run, "hidden", "Hidden vehicles", intro, seeds, reporter, data="results")
    studies = {name: train_all(preset, seeds, run, reporter) for name, preset in presets.items()}
    about = " ".join(study.about() for study in studies.values())
    for course in courses:
        result = list[dict[str, Any]]()
        for entrant in entrants:
            if run.interrupted:
                break
            reporter.say(f"{course.title}: {entrant.label}, {count} vehicles")
            flights = _fly(studies[entrant.preset], entrant, course, vehicles, run, reporter, seeds, starts, sensors)
            result += [_row(entrant, course, vehicles, flight, scoring) for flight in flights]
        if result:
            document.add(_section(result, entrants, course, scoring, vehicles, run, about), result)
    document.write()
    if not run.interrupted:
        clear_flights(run)


def _scenario(course: Course, vehicle: HiddenVehicle, sensors: str) -> Scenario:
    return vehicle.scenario(course.disturbance, sensors=sensors, reference=course.reference)


def _fly(
    study: Study,
    entrant: Entrant,
    course: Course,
    vehicles: Sequence[HiddenVehicle],
    run: Run,
    reporter: Reporter,
    seeds: Sequence[int],
    starts: int,
    sensors: str,
) -> list[Flight]:
    """Return the flights of all vehicles by one entrant."""
    if entrant.once:
        seeds, starts = seeds[:1], 1
        study = replace(study, policies={seed: study.policies[seed] for seed in seeds if seed in study.policies})
    scenarios = [_scenario(course, vehicle, sensors) for vehicle in vehicles]
    options: dict[str, Any] = {"methods": (entrant.method,), "starts": starts, "seconds": course.seconds}
    if entrant.file == "none":
        return fly_all(study, scenarios, run, reporter, **options).flights
    flights = list[Flight]()
    for vehicle, scenario in zip(vehicles, scenarios, strict=True):  # each vehicle file needs its own set-up
        preset = entrant.inform(study.preset, vehicle)
        own = train_all(preset, seeds, run, reporter) if entrant.file == "trained" else replace(study, preset=preset)
        flights += fly_all(own, [scenario], run, reporter, **options).flights
    return flights


def _row(
    entrant: Entrant, course: Course, vehicles: Sequence[HiddenVehicle], flight: Flight, scoring: Scoring
) -> dict[str, Any]:
    """Return the scores of one flight and its vehicle's parameters; None stands for infinity."""
    number = next(n for n, each in enumerate(vehicles) if each.spec == flight.spec.scenario.vehicle)
    vehicle = vehicles[number]
    return {
        "course": course.title,
        "preset": entrant.preset,
        "method": entrant.method,
        "vehicle_file": entrant.file,
        "seed": flight.spec.seed,
        "start": flight.spec.start,
        "vehicle": number,
        "mass_kg": vehicle.spec.mass,
        "rate_lag_s": vehicle.rate_lag,
        "damping": vehicle.damping,
        "delay_s": vehicle.delay,
        "thrust_lag_s": vehicle.spec.motor_tau,
        "thrust_gain": vehicle.thrust_gain,
        "thrust_to_weight": round(vehicle.thrust_to_weight, 3),
        "lost": flight.log.terminated,
        **{name: value if np.isfinite(value) else None for name, value in scoring.score(flight).items()},
    }


def _section(
    rows: Sequence[dict[str, Any]],
    entrants: Sequence[Entrant],
    course: Course,
    scoring: Scoring,
    vehicles: Sequence[HiddenVehicle],
    run: Run,
    about: str,
) -> TableSection:
    lines, maps, (colour_metric, *_) = list[tuple[str, ...]](), dict[str, np.ndarray](), scoring.columns
    means = colour_metric.startswith("rms")
    for entrant in entrants:
        key = entrant.preset, entrant.method, entrant.file
        own = [row for row in rows if (row["preset"], row["method"], row["vehicle_file"]) == key]
        if not own:
            continue
        losses, label = sum(row["lost"] for row in own), find_method(entrant.method).label
        cells = [_quantiles([row[name] for row in own], name) for name in scoring.columns]
        finite = [row[colour_metric] for row in own if row[colour_metric] is not None]
        cells += [metres(float(np.mean(finite))) if finite else "-"] if means else []
        lines.append((f"`{entrant.preset}`", label, KNOWLEDGE[entrant.file], f"{losses} of {len(own)}", *cells))
        worst = np.full(len(vehicles), -np.inf)
        for row in own:
            worst[row["vehicle"]] = max(
                worst[row["vehicle"]], np.inf if row[colour_metric] is None else row[colour_metric]
            )
        maps[entrant.label] = worst
    lag, delay = (np.array([getattr(v, name) for v in vehicles]) for name in ("rate_lag", "delay"))
    picture = plots.save(vehicle_map(course.title, lag, delay, maps, scoring.colour), run.folder, course.stem)[0]
    columns = ("preset", "method", "vehicle", "lost", *scoring.columns.values(), *(["mean RMSE [m]"] if means else []))
    return TableSection(columns, tuple(lines), course.title, about, picture)


def _quantiles(values: Sequence[float | None], name: str) -> str:
    """Return the median, the 95th percentile and the worst value over all flights."""
    ranking = np.sort([np.inf if value is None else value for value in values])
    quantiles = [ranking[min(len(ranking) - 1, int(share * len(ranking)))] for share in (0.5, 0.95, 1.0)]
    text = metres if name.endswith("_m") else "{:.2f}".format
    return " / ".join(text(value) if np.isfinite(value) else "∞" for value in quantiles)
