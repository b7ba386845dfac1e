"""Runs sweeps of policies x scenarios x seeds from one TOML file; a killed sweep can be resumed."""

import dataclasses
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

from jax import random
from pydantic import ConfigDict, Field, Strict
from pydantic.dataclasses import dataclass

from ..config.limits import check_once, check_seeds
from ..config.loading import beside, changed, dump, load
from ..config.presets import Preset
from ..config.scenario import Scenario
from ..config.setup import Setup
from ..config.trust import check_trust
from ..config.validation import read_toml, validate
from ..config.vehicle_file import VehicleSpec
from ..config.vehicles import name_of
from ..control.policy import AbstractPolicy
from ..io.logs.recording import write_npz
from ..runkit.codecs import rows_codec
from ..runkit.document import Document, TableSection
from ..runkit.file_digests import file_digests, preset_names, scenario_names
from ..runkit.flights import Flight, FlightSpec
from ..runkit.outputs import recording_of
from ..runkit.provenance import section_key
from ..runkit.reporter import Reporter
from ..runkit.run import Run
from ..viz.panels import bars
from ..viz.plots import save
from .executor import report_progress
from .fleet import Fleet
from .flight_table import figure_cells, figure_columns, millimetres
from .metrics import Rows, conditions_of, failed_record, record, summary
from .policies import train_policies
from .stored_record import is_record

FLIGHTS = "flights"
"""Key of the rows of completed flights."""
STRICT = ConfigDict(extra="forbid")
GROUP = ("preset", "plant", "vehicle", "sensors", "reference", "disturbance", "method")


@dataclass(frozen=True, config=STRICT)
class Sweep:
    """The contents of a sweep file."""

    presets: tuple[str, ...] = Field(default=("hover/retrim",), min_length=1)
    """Presets; a policy is trained with each preset and seed."""
    seeds: tuple[Annotated[int, Strict()], ...] = Field(default=(0,), min_length=1)
    """Training seeds; each one also seeds the starts, disturbances and learners of its flights."""
    methods: tuple[str, ...] = Field(default=("base", "full"), min_length=1)
    disturbances: tuple[str, ...] = Field(default=("none",), min_length=1)
    plants: tuple[str, ...] = Field(default=("bem",), min_length=1)
    vehicles: tuple[str | VehicleSpec, ...] = ()
    """Vehicles of the flights; by default that of training. Paths are relative to the sweep file; contents are kept."""
    sensors: tuple[str, ...] = Field(default=("ideal",), min_length=1)
    references: tuple[str, ...] = ()
    """References for tracking policies."""
    starts: int = Field(default=1, ge=1, le=100_000, strict=True)
    seconds: float | None = Field(default=None, ge=1.0, le=36_000.0, strict=True)
    """Length of a flight [s]; the task's own by default."""
    logs: bool = Field(default=False, strict=True)
    """Whether the log of each flight is written to ``logs/``; its row has the name of the file as ``log``."""
    overlay: dict[str, Any] = Field(default_factory=dict)
    """Values that override every preset's, in the preset format. A vehicle file is relative to the sweep file."""

    def scenarios(self) -> list[Scenario]:
        """Return every combination of disturbance, plant, vehicle, sensors and reference."""
        return [
            Scenario(disturbance, plant, vehicle, sensors, reference=reference)
            for plant in self.plants
            for vehicle in self.vehicles or (None,)
            for sensors in self.sensors
            for reference in self.references or (None,)
            for disturbance in self.disturbances
        ]


def read_sweep(path: Path, trust: Collection[str] = ()) -> Sweep:
    """Read a sweep file.

    Args:
        path: The file.
        trust: Python names that it may refer to, for example ``mine:task``.

    Raises:
        ConfigError: The file cannot be read, a key or value is invalid, or it names Python code that is not trusted.
    """
    tables = read_toml(path)
    if isinstance(overlay := tables.get("overlay"), dict):
        tables["overlay"] = beside(overlay, path.parent)
    if isinstance(names := tables.get("vehicles"), list):
        tables["vehicles"] = [beside({"vehicle": name}, path.parent)["vehicle"] for name in names]
    sweep = validate(Sweep, tables, source=str(path))
    check_trust(tables, trust, source=str(path))
    return sweep


def run_sweep(sweep: Sweep, run: Run, reporter: Reporter) -> Rows:
    """Train all policies and fly all flights that are not yet in the run's folder.

    Policies are stored in ``policies/``, and a row for each flight in ``flights.jsonl``. After being killed, the run
    resumes from the policies and rows that the same code made from the same files. ``sweep.md``, ``sweep.json`` and
    ``sweep.png`` are written at the end, and after an interruption.

    Returns:
        One row per preset, scenario and method.

    Raises:
        ConfigError: A name does not exist, or two settings are incompatible; raised before any training.
    """
    check_seeds(sweep.seeds)
    for what in ("presets", "methods", "disturbances", "plants", "sensors", "references"):
        check_once(getattr(sweep, what), f"{what}: {{}} is listed twice; list each only once")
    names = [name_of(vehicle) for vehicle in sweep.vehicles]
    check_once(names, "two vehicles are named {}; list each only once, and give each file its own name")
    presets = [changed(load(name), **sweep.overlay) for name in sweep.presets]
    names = [preset.name for preset in presets]
    check_once(names, "two presets are named {}; give each its own name, and none in [overlay]")
    fleets = [_fleet(preset, _make_untrained(preset, sweep), sweep) for preset in presets]
    for fleet in fleets:
        for scenario in sweep.scenarios():
            scenario.make(fleet.preset.vehicle, dt=fleet.preset.dt)  # fails if a package is missing
    # The keys are made once, before the first flight; a file that changes in the meantime affects only the next run.
    keys = [{spec: _key(fleet.preset, spec, fleet.seconds) for spec in fleet.specs} for fleet in fleets]
    conditions = {
        key: {"preset": fleet.preset.name, **conditions_of(spec, spec.scenario.vehicle_name(fleet.preset.vehicle))}
        for fleet, of_fleet in zip(fleets, keys, strict=True)
        for spec, key in of_fleet.items()
    }
    rows = _FlightRows(run, reporter, conditions, need_logs=sweep.logs)
    for preset, of_fleet in zip(presets, keys, strict=True):
        with run.interruptible():
            policies = train_policies(preset, sweep.seeds, run, reporter)
            if not run.interrupted:
                _fly(_fleet(preset, policies, sweep), of_fleet, rows, run, reporter)
        if run.interrupted:
            break
    every = [key for of_fleet in keys for key in of_fleet.values()]
    run.reused += len(rows.earlier.intersection(every))
    return _report(sweep, [rows.by_key[key] for key in every if key in rows.by_key], run, reporter)


def _fleet(preset: Preset, policies: Mapping[int, AbstractPolicy], sweep: Sweep) -> Fleet:
    return Fleet(preset, policies, sweep.scenarios(), methods=sweep.methods, starts=sweep.starts, seconds=sweep.seconds)


def _make_untrained(preset: Preset, sweep: Sweep) -> dict[int, AbstractPolicy]:
    """Return untrained policies for planning the flights before training."""
    return dict.fromkeys(sweep.seeds, Setup.from_preset(preset).new_policy(random.key(0)))


def _fly(fleet: Fleet, keys: Mapping[FlightSpec, str], rows: "_FlightRows", run: Run, reporter: Reporter) -> None:
    """Fly the missing flights, and store the rows of the completed ones."""
    missing = [spec for spec, key in keys.items() if not rows.has(key)]
    if not missing or run.interrupted:
        return

    def on_result(flights: Sequence[Flight]) -> None:
        result = dict[str, dict[str, Any]]()
        for flight in flights:
            key = keys[flight.spec]
            result[key] = {"preset": fleet.preset.name, **record(flight), **rows.write_log(key, flight)}
        rows.add(result)

    with reporter.progress(f"flying {fleet.preset.name}") as advance:
        advance(0.0, "compiling the programs of a flight")
        flights = fleet.run(
            run.executor,
            stop=run.stop,
            only=missing,
            on_result=on_result,
            progress=report_progress(advance),
            by_batch=True,
            forget=True,
        )
    for spec, why in flights.failed.items():
        vehicle = spec.scenario.vehicle_name(fleet.preset.vehicle)
        row = failed_record(spec, vehicle, fleet.setups[spec.scenario.reference].flight_task.metric, why)
        rows.add({keys[spec]: {"preset": fleet.preset.name, **row}})
    if flights.failed:
        run.failed = True
        why = next(iter(flights.failed.values()))
        reporter.say(
            f"{len(flights.failed)} flights failed in other processes, the first with {why}; "
            "the same command flies them"
        )


class _FlightRows:
    """Rows of completed flights by their keys, one line of JSON each; failed flights and unusable lines fly again."""

    def __init__(
        self, run: Run, reporter: Reporter, conditions: Mapping[str, Mapping[str, Any]], *, need_logs: bool = False
    ) -> None:
        """Read the rows of an earlier run.

        Args:
            run: Run whose folder has the rows.
            reporter: Receives a line about rows that cannot be used.
            conditions: Conditions of each flight of the sweep, by its key, which its row must have.
            need_logs: Whether each row needs the log of its flight; flights without a log fly again.
        """
        self._store, self._folder, self._need_logs = run.store(reporter), run.folder, need_logs
        lines = self._store.get(FLIGHTS, rows_codec()) or ()
        records = [row for row in lines if is_record(row, conditions)]
        if unusable := len(lines) - len(records):
            path = self._store.path(FLIGHTS, rows_codec())
            reporter.say(f"{path}: unusable lines, {unusable}; their flights are flown again")
        self.by_key = {row["key"]: row for row in records if row["failed"] is None}
        self.earlier = frozenset(filter(self.has, self.by_key))

    def has(self, key: str) -> bool:
        """Return whether a flight is complete: its row exists, and its log if logs are needed."""
        return key in self.by_key and (not self._need_logs or self._log(key).is_file())

    def write_log(self, key: str, flight: Flight) -> dict[str, str]:
        """Write the log of a flight if logs are needed, and return the entry of its row."""
        if not self._need_logs:
            return {}
        path = self._log(key)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_npz(path, recording_of(flight))
        return {"log": path.relative_to(self._folder).as_posix()}

    def _log(self, key: str) -> Path:
        return self._folder / "logs" / f"{key}.npz"

    def add(self, rows: Mapping[str, Mapping[str, Any]]) -> None:
        """Add rows by their keys, and store all rows."""
        self.by_key |= {key: {"key": key, **row} for key, row in rows.items()}
        self._store.put(FLIGHTS, list(self.by_key.values()), rows_codec())


def _key(preset: Preset, spec: FlightSpec, seconds: float) -> str:
    files = file_digests(spec.method, *preset_names(preset), *scenario_names(spec.scenario))
    return section_key(preset=dump(preset), spec=repr(spec), seconds=seconds, files=files)


def _report(sweep: Sweep, rows: Sequence[dict[str, Any]], run: Run, reporter: Reporter) -> Rows:
    """Write the documents about the completed flights, in the order of the sweep."""
    groups: dict[tuple[Any, ...], list[dict[str, Any]]] = {}
    for row in rows:
        groups.setdefault(tuple(row[name] for name in GROUP), []).append(row)
    result, cells = Rows(), list[tuple[str, ...]]()
    varying_groups = [
        name for i, name in enumerate(GROUP) if len({group[i] for group in groups}) > 1 or name == "method"
    ]
    for flights in groups.values():
        row = summary(flights, GROUP)
        result.append(row)
        none = "crashed" if row["crashes"] else "-"
        spread = (none if row[name] is None else millimetres(row[name]) for name in ("median", "max"))
        error, *others = figure_cells(row)
        cells.append((*(str(flights[0][name]) for name in varying_groups), error, *spread, *others))
    intro = (
        "Made by `retrim sweep`. Error over the last seconds of each flight: mean ± standard deviation, median and "
        "maximum over seeds and starts. Median of the largest error after the flight to the goal, and of the time from "
        "which the error stays below the bound."
    )
    more = {"sweep": dataclasses.asdict(sweep)}
    document = Document(run, "sweep", "Sweep", intro, sweep.seeds, reporter, more)
    if cells:
        picture_path = save(bars("Error at the end of the flights [m]", _bar_groups(groups)), run.folder, "sweep")
        error, *others = figure_columns(sweep.seconds)
        columns = (*varying_groups, error, "median [mm]", "maximum [mm]", *others)
        document.add(TableSection(columns, tuple(cells), picture=picture_path[0]), result)
    document.write()
    return result


def _bar_groups(groups: Mapping[tuple[Any, ...], list[dict[str, Any]]]) -> dict[str, dict[str, list[float]]]:
    """Return the flights' errors by scenario and method; a crashed flight's error is infinite."""
    bar_groups: dict[str, dict[str, list[float]]] = {}
    varying_groups = [i for i, name in enumerate(GROUP[:-1]) if len({group[i] for group in groups}) > 1] or [5]
    for group, flights in groups.items():
        label = ", ".join(str(group[i]) for i in varying_groups)
        bar_groups.setdefault(label, {})[str(group[-1])] = [
            float("inf") if row["error"] is None else row["error"] for row in flights if not row.get("failed")
        ]
    return bar_groups
