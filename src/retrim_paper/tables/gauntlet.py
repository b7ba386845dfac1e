"""Flies the gauntlet: one policy under many changes in the world."""

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np

from retrim.config.loading import load
from retrim.config.methods import find_method
from retrim.config.presets import Preset
from retrim.config.scenario import Scenario
from retrim.config.setup import Setup
from retrim.errors import ConfigError, JobError, PlantError
from retrim.evaluation.flight_groups import clear_flights
from retrim.evaluation.metrics import metres
from retrim.evaluation.study import fly_all, refuse_misfits, table_presets, train_all
from retrim.runkit.document import Document, TableSection
from retrim.runkit.flights import Flight
from retrim.runkit.provenance import cores
from retrim.runkit.recovery import change_times, recoveries
from retrim.runkit.reporter import Reporter
from retrim.runkit.run import Run
from retrim.viz import plots
from retrim.viz.panels import Curve, Panel, heat_map, panel_figure

from ..conditions import conditions, fault_conditions
from .hidden import fly_hidden
from .hidden_entrants import VehicleFile, entrants_of
from .promise import promise_rows, promise_section

METHODS: dict[str, tuple[str, ...]] = {
    "hover": ("base", "base-i", "base-do", "geometric-i", "indi", "full"),
    "track": ("base", "base-i", "base-do", "geometric-i", "indi", "full"),
    "vision": ("base", "base-do", "full"),  # methods that every preset supports
}
FAULT_METHODS = ("base", "base-do", "geometric-i", "indi", "full", "lora")
CORES = 2  # cores used by one condition; only its adapting flights, from a few starts, take long
METRICS = {"steady": "[m]", "late": "[m]", "peak": "[m]", "recovery_5cm": "[s]", "recovery_2cm": "[s]"}
INTRO = """\
Made by `retrim gauntlet`. The preset's own vehicle on plant `bem`, with {sensors} sensors, unless the row names a
different one, at hover or on the reference that the row names. steady: mean error over the last 2 s of hover, or the
last 10 s of tracking; late: mean error after 5 s; peak: largest error after 5 s; recovery: time after a change in
conditions until the error stays below 5 or 2 cm (without a change: from the start, 1 m away). Means over flights, and
the worst in brackets; a flight that crashed, or did not recover, is infinite (∞). Learning is charged to flight time by
the preset's fixed latencies."""

FAULTS_INTRO = """\
Made by `retrim gauntlet --faults`. The preset's own vehicle on plant `bem` with {sensors} sensors hovers under a push
of 0.5 m/s^2 per axis and one fault, which is unknown to the policy: a fault of the measurements (the names are those of
`--fault`), of the command delay, of the mass or of the thrust. steady: mean error over the last 2 s; late: mean error
after 5 s; peak: largest error after 5 s, all of the true position; recovery: time from the start, 1 m away, until the
error stays below 5 or 2 cm. Means over flights, and the worst in brackets; a flight that crashed, or did not recover,
is infinite (∞). Learning is charged to flight time by the preset's fixed latencies."""


def gauntlet(
    run: Run,
    reporter: Reporter,
    *,
    preset: str = "hover/retrim",
    only: tuple[str, ...] = (),
    methods: tuple[str, ...] = (),
    seeds: tuple[int, ...] = (0,),
    seconds: float = 30.0,
    starts: int = 4,
    sensors: str = "ideal",
    faults: bool = False,
    vehicles: Literal["own", "hidden"] = "own",
    count: int = 200,
    draw: int = 0,
    file: VehicleFile = "none",
) -> None:
    """A policy under many changes in the world: recovery, steady error and worst error, as one heat map.

    Args:
        run: Folder for gauntlet.md, results.json and the pictures.
        reporter: Receives progress and the table.
        preset: Preset for hover, tracking or vision, with which the policy is trained.
        only: Conditions to fly; all by default. A condition whose plant is not installed is left out and reported.
        methods: Methods to fly; by default base, base-i, base-do, geometric-i, indi and full, and for vision base,
            base-do and full.
        seeds: Training seeds; each also seeds the starts, gusts and learners of its flights.
        seconds: Length of a flight [s]; flights of hidden vehicles last 10 s, or 25 s on figure-8s.
        starts: Flights per condition, method and seed.
        sensors: Sensors of the conditions that do not name their own: ideal, mocap, onboard, rough or camera.
        faults: Instead, fly measurement and vehicle faults at hover, and check that adapting is never worse than not
            adapting; the default methods are then base, base-do, geometric-i, indi, full and lora.
        vehicles: own flies the preset's vehicle under all conditions; hidden flies many vehicles that are unknown to
            every method, at hover under a push, or on figure-8s with a preset for tracking. Without --methods, the
            page compares hover/any or track/any with methods for a known vehicle.
        count: Number of hidden vehicles.
        draw: Seed from which the hidden vehicles are drawn.
        file: Vehicle file that the given methods receive for hidden vehicles: none; wrong, by up to a factor of two;
            true; or trained, the true one and one policy per vehicle.
    """
    task = load(preset).task
    if vehicles == "hidden":
        if only or faults:
            raise ConfigError("--vehicles hidden has one condition, so that --only and --faults do not apply to it")
        entrants = entrants_of(task, preset, methods, file)
        sizes: dict[str, Any] = {"count": count, "draw": draw, "seeds": seeds, "starts": starts, "sensors": sensors}
        return fly_hidden(run, reporter, task=task, entrants=entrants, **sizes)
    if file != "none":
        raise ConfigError(f"--file {file} needs --vehicles hidden")
    if task not in METHODS:
        raise ConfigError(f"preset {preset!r} is for {task}; the gauntlet is flown for {', '.join(METHODS)}")
    if faults and (task != "hover" or sensors != "ideal"):
        raise ConfigError(f"--faults needs a preset for hover and ideal sensors, got {preset!r} and {sensors!r}")
    methods = methods or (FAULT_METHODS if faults else METHODS[task])
    (base,) = table_presets([preset], task, seeds=seeds, starts=starts, seconds=seconds)
    all_conditions = fault_conditions(base) if faults else conditions(base, sensors)
    if unknown := [name for name in only if name not in all_conditions]:
        raise ConfigError(f"no condition {unknown[0]!r}; there are {', '.join(all_conditions)}")
    available, unavailable = _select_installed(base, {name: all_conditions[name] for name in only or all_conditions})
    refuse_misfits(base, list(available.values()), methods=methods, starts=starts, seconds=seconds)
    for line in unavailable:
        reporter.say(f"left out: {line}")
    name, title = ("faults", "Faults of measurements and vehicle") if faults else ("gauntlet", "The gauntlet")
    intro = (FAULTS_INTRO if faults else INTRO).format(sensors=sensors)
    document = Document(run, name, title, intro, seeds, reporter, data="results")
    study = train_all(base, seeds, run, reporter)
    home, by_condition, result = (
        Setup.from_preset(base).flight_task.home(),
        dict[str, list[Flight]](),
        list[dict[str, Any]](),
    )
    names, at_once = list(available), max(1, cores() // CORES)
    for together in (names[n : n + at_once] for n in range(0, len(names), at_once)):
        if run.interrupted:
            break
        reporter.say(f"condition {', '.join(together)}")
        scenarios = [available[name] for name in together]
        try:
            flights = fly_all(study, scenarios, run, reporter, methods=methods, starts=starts, seconds=seconds).flights
        except JobError as error:
            unavailable.append(f"{', '.join(together)}: {error}")
            continue
        for name, scenario in zip(together, scenarios, strict=True):
            if own := [flight for flight in flights if flight.spec.scenario == scenario]:
                by_condition[name] = own
                result += rows_of(name, own, change_times(scenario.disturbance, home, seconds))
        if result:
            run.write_results(result, seeds=seeds)  # written now, so that a kill loses only running flights
    if result:
        if faults:
            document.more["promise"] = promise_rows(by_condition)
            document.add(promise_section(document.more["promise"]))
        document.add(_section(result, methods, by_condition, document, study.about(), unavailable), result)
    document.write()
    if not run.interrupted:
        clear_flights(run)


def _select_installed(preset: Preset, request: Mapping[str, Scenario]) -> tuple[dict[str, Scenario], list[str]]:
    """Return the conditions whose plants are installed, and a line about each of the others.

    Raises:
        PlantError: No condition has an installed plant.
    """
    result, lacking, why = dict[str, Scenario](), list[str](), None
    for name, scenario in request.items():
        try:
            scenario.make(preset.vehicle, dt=preset.dt)
            result[name] = scenario
        except PlantError as error:
            lacking.append(f"{name}: {error}")
            why = error
    if why is not None and not result:
        raise why
    return result, lacking


def rows_of(name: str, flights: Sequence[Flight], changes: Sequence[float]) -> list[dict[str, Any]]:
    """Return a condition's rows, one for each method and metric.

    Args:
        name: Name of the condition.
        flights: Flights of the condition.
        changes: Times at which the world changed [s].
    """
    result = list[dict[str, Any]]()
    for method in dict.fromkeys(flight.spec.method for flight in flights):
        group = [flight for flight in flights if flight.spec.method == method]
        values = {
            "steady": [np.inf if f.log.terminated else f.steady for f in group],
            "late": [f.late for f in group],
            "peak": [f.peak for f in group],
            "recovery_5cm": [each for f in group for each in _recoveries(f, changes, 0.05)],
            "recovery_2cm": [each for f in group for each in _recoveries(f, changes, 0.02)],
        }
        scenario = group[0].spec.scenario
        for metric in METRICS:
            mean, worst = float(np.mean(values[metric])), float(np.max(values[metric]))
            result.append(
                {
                    "scenario": name,
                    "method": method,
                    "metric": metric,
                    "value": mean if np.isfinite(mean) else None,
                    "worst": worst if np.isfinite(worst) else None,
                    "n": len(group),
                    "crashes": sum(f.log.terminated for f in group),
                    "disturbance": scenario.disturbance,
                    "plant": scenario.plant,
                    "vehicle": group[0].vehicle,
                    "sensors": scenario.sensors,
                    "thrust_error": scenario.thrust_error,
                    "delay": scenario.delay,
                    "reference": scenario.reference,
                    "fault": scenario.fault,
                }
            )
    return result


def _recoveries(flight: Flight, changes: Sequence[float], limit: float) -> list[float]:
    return recoveries(flight.log.t, flight.error, changes, limit, terminated=flight.log.terminated)


def _section(
    results: Sequence[dict[str, Any]],
    methods: Sequence[str],
    by_condition: dict[str, list[Flight]],
    document: Document,
    about: str,
    unavailable: Sequence[str],
) -> TableSection:
    by = {(row["scenario"], row["method"], row["metric"]): row for row in results}
    lines, names = list[tuple[str, ...]](), list(by_condition)
    for name in names:
        for method in methods:
            rows = [by[name, method, metric] for metric in METRICS if (name, method, metric) in by]
            if rows:
                crash_text = f"{rows[0]['crashes']} of {rows[0]['n']}"
                lines.append((name, find_method(method).label, *map(_cell, rows), crash_text))
    columns = tuple(f"{metric} {unit}" for metric, unit in METRICS.items())
    metrics = ("late", "peak", "recovery_2cm")
    values = [[[_value(by.get((name, m, metric))) for m in methods] for name in names] for metric in metrics]
    titles = [f"{metric} {METRICS[metric]}" for metric in metrics]
    map_path = plots.save(heat_map(titles, names, methods, np.array(values)), document.run.folder, document.name)
    plots.save(_best_and_worst(by_condition), document.run.folder, f"{document.name}_flights")
    notes = "".join(f" Left out: {line}" for line in unavailable)
    return TableSection(("condition", "method", *columns, "crashed"), tuple(lines), "", about + notes, map_path[0])


def _value(row: dict[str, Any] | None) -> float:
    return np.nan if row is None else np.inf if row["value"] is None else row["value"]


def _cell(row: dict[str, Any]) -> str:
    text = metres if METRICS[row["metric"]] == "[m]" else "{:.3f}".format
    value, worst = ("∞" if row[key] is None else text(row[key]) for key in ("value", "worst"))
    return f"{value} ({worst})"


def _best_and_worst(by_condition: dict[str, list[Flight]]) -> Any:
    """Plot all methods' errors from the starts where the last method had its smallest and its largest peak."""
    last = [
        (name, f) for name, flights in by_condition.items() for f in flights if f.spec.method == flights[-1].spec.method
    ]
    ranking = sorted(last, key=lambda pair: pair[1].peak)
    panels = []
    for title, (name, flight) in (("best", ranking[0]), ("worst", ranking[-1])):
        same = [f for f in by_condition[name] if (f.spec.start, f.spec.seed) == (flight.spec.start, flight.spec.seed)]
        curves = [Curve(f.log.t, 1000 * f.error, f.spec.method) for f in same]
        panels.append(Panel(f"{title}: {name}, start {flight.spec.start}", "time [s]", "error [mm]", curves))
    return panel_figure("The best and the worst flight", panels, across=2)
