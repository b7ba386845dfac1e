"""The gauntlet of hidden vehicles: one policy, and many vehicles that it is told nothing of."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ...config.hidden_vehicles import HiddenVehicle, draw_vehicles
from ...config.loading import load_for
from ...config.methods import find_method
from ...config.presets import Preset
from ...errors import ConfigError
from ...viz import plots
from ...viz.vehicle_map import vehicle_map
from ..flights import Flight
from ..limits import check_flights, check_seeds
from ..metrics import metres
from ..recovery import recoveries
from ..reporter import Reporter
from ..run import Run
from .document import Document, TableSection
from .kept_flights import forget_flights
from .study import Study, fly_all, refuse_misfits, train_all

PUSH, PUSHED = "early-step", 4.0  # and its time [s]
AFTER = 5.0  # [s] after the push: the error is scored for one second from here on
SECONDS = PUSHED + AFTER + 1.0
SHOWN = ("error_m", "to_10cm_s", "to_2cm_s", "peak_m")
INTRO = """\
Made by `retrim gauntlet --vehicles hidden`: {count} vehicles, drawn from one size factor (seed {seed}), from 30 g to
3 kg: lag of the body rates 15 to 150 ms (second order, damping ratio 0.4 to 1.2), command delay 0 to 60 ms, thrust lag
10 to 80 ms, thrust gain 0.6 to 1.6, and at full command 1.4 times the weight or more. Plant `second-order`, {sensors}
sensors. Each vehicle hovers from 1 m away; a push of 2 m/s^2 per axis begins at 4 s. Columns "not told": the method
receives no vehicle file. Rows "vehicle known": the method receives the true mass, limits, delay and lags, but not the
thrust gain. lost: flights that left the bounds. error: mean from 5 to 6 s after the push. to 10 cm, to 2 cm: time after
the push until the error stays below; infinite (∞) where it never does. peak: largest error after the push. Median over
all flights, the 95th percentile, and the worst; a lost flight counts as infinite."""


@dataclass(frozen=True)
class Entrant:
    """A preset and a method of the benchmark."""

    preset: str
    method: str
    told: bool = False
    """Whether the method receives a vehicle file with the true numbers."""

    @property
    def label(self) -> str:
        """Name in tables and figures."""
        return f"{self.method}, vehicle known" if self.told else f"{self.preset} {self.method}"


OPPONENTS = ("base", "base-do", "geometric-i", "indi", "full")
FAMILY = ("base-id", "full")
ENTRANTS = (
    *(Entrant("hover/retrim", method) for method in OPPONENTS),
    Entrant("hover/retrim", "indi", told=True),
    *(Entrant("hover/any", method) for method in FAMILY),
)


def entrants_of(preset: str, methods: Sequence[str]) -> tuple[Entrant, ...]:
    """Return the entrants of a command: those of the published page, or the methods of one preset.

    Args:
        preset: Name of a preset, or a file.
        methods: Methods to fly; none for the published ones.
    """
    return tuple(Entrant(preset, method) for method in methods) if methods else ENTRANTS


def fly_hidden(
    run: Run,
    reporter: Reporter,
    *,
    entrants: Sequence[Entrant],
    count: int,
    draw: int,
    seeds: tuple[int, ...],
    starts: int,
    sensors: str,
) -> None:
    """Fly hidden vehicles, and write ``hidden.md``, ``results.json`` and a map.

    Args:
        run: Folder of the results.
        reporter: Receives progress and the table.
        entrants: Presets and methods.
        count: Number of vehicles.
        draw: Seed of the vehicles.
        seeds: Training seeds.
        starts: Flights per vehicle, method and training seed.
        sensors: Name of a sensor model.

    Raises:
        ConfigError: Something does not exist, or does not fit together; nothing has been trained.
    """
    if not 1 <= count <= 10_000:
        raise ConfigError(f"count must be 1 to 10000 vehicles, got {count}")
    check_seeds(seeds)
    check_flights(starts, SECONDS)
    vehicles = draw_vehicles(count, draw)
    presets = {name: load_for("hover", name) for name in dict.fromkeys(each.preset for each in entrants)}
    first = [vehicles[0].scenario(PUSH, sensors=sensors)]
    for entrant in entrants:
        refuse_misfits(presets[entrant.preset], first, methods=(entrant.method,), starts=starts, seconds=SECONDS)
    intro = INTRO.format(count=count, seed=draw, sensors=sensors)
    document = Document(run, "hidden", "Hidden vehicles", intro, seeds, reporter, data="results")
    studies = {name: train_all(preset, seeds, run, reporter) for name, preset in presets.items()}
    found = list[dict[str, Any]]()
    for entrant in entrants:
        if run.interrupted:
            break
        reporter.say(f"{entrant.label}: {count} vehicles")
        flights = _fly(studies[entrant.preset], entrant, vehicles, run, reporter, starts, sensors)
        found += [_row(entrant, vehicles, flight) for flight in flights]
    if found:
        document.add(_section(found, entrants, vehicles, run, [study.about() for study in studies.values()]), found)
    document.write()
    if not run.interrupted:
        forget_flights(run)


def _fly(
    study: Study,
    entrant: Entrant,
    vehicles: Sequence[HiddenVehicle],
    run: Run,
    reporter: Reporter,
    starts: int,
    sensors: str,
) -> list[Flight]:
    """Return the flights of all vehicles by one entrant."""
    scenarios = [vehicle.scenario(PUSH, sensors=sensors) for vehicle in vehicles]
    options: dict[str, Any] = {"methods": (entrant.method,), "starts": starts, "seconds": SECONDS}
    if not entrant.told:
        return fly_all(study, scenarios, run, reporter, **options).flown
    flights = list[Flight]()
    for vehicle, scenario in zip(vehicles, scenarios, strict=True):  # each file makes another set-up
        told = replace(study, preset=_told(study.preset, vehicle))
        flights += fly_all(told, [scenario], run, reporter, **options).flown
    return flights


def _told(preset: Preset, vehicle: HiddenVehicle) -> Preset:
    return replace(preset, vehicle=vehicle.spec)


def _row(entrant: Entrant, vehicles: Sequence[HiddenVehicle], flight: Flight) -> dict[str, Any]:
    """Return the figures of one flight beside those of its vehicle; None stands for infinity."""
    number = int(flight.vehicle.rpartition("-")[2])
    vehicle, log, error = vehicles[number], flight.log, flight.error
    lost = log.terminated
    scored = log.t >= PUSHED + AFTER - 1e-6
    values = {
        "error_m": np.inf if lost else float(np.mean(error[scored])),
        "to_10cm_s": recoveries(log.t, error, [PUSHED], 0.1, terminated=lost)[0],
        "to_2cm_s": recoveries(log.t, error, [PUSHED], 0.02, terminated=lost)[0],
        "peak_m": np.inf if lost else float(np.max(error[log.t >= PUSHED])),
    }
    return {
        "preset": entrant.preset,
        "method": entrant.method,
        "vehicle_known": entrant.told,
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
        "lost": lost,
        **{name: value if np.isfinite(value) else None for name, value in values.items()},
    }


def _section(
    found: Sequence[dict[str, Any]],
    entrants: Sequence[Entrant],
    vehicles: Sequence[HiddenVehicle],
    run: Run,
    about: Sequence[str],
) -> TableSection:
    lines, maps = list[tuple[str, ...]](), dict[str, np.ndarray]()
    for entrant in entrants:
        own = [
            row
            for row in found
            if (row["preset"], row["method"], row["vehicle_known"]) == (entrant.preset, entrant.method, entrant.told)
        ]
        if not own:
            continue
        lost = sum(row["lost"] for row in own)
        label = find_method(entrant.method).label
        known = "known" if entrant.told else "not told"
        cells = (_quantiles([row[name] for row in own], name) for name in SHOWN)
        lines.append((f"`{entrant.preset}`", label, known, f"{lost} of {len(own)}", *cells))
        worst = np.full(len(vehicles), -np.inf)
        for row in own:
            worst[row["vehicle"]] = max(worst[row["vehicle"]], np.inf if row["error_m"] is None else row["error_m"])
        maps[entrant.label] = worst
    lag, delay = (np.array([getattr(v, name) for v in vehicles]) for name in ("rate_lag", "delay"))
    picture = plots.save(vehicle_map("Vehicles that no method knows", lag, delay, maps), run.folder, "hidden")[0]
    columns = ("preset", "method", "vehicle", "lost", "error [m]", "to 10 cm [s]", "to 2 cm [s]", "peak [m]")
    return TableSection(columns, tuple(lines), "", " ".join(about), picture)


def _quantiles(values: Sequence[float | None], name: str) -> str:
    """Return median, 95th percentile and worst value of all flights."""
    ranked = np.sort([np.inf if value is None else value for value in values])
    chosen = [ranked[min(len(ranked) - 1, int(share * len(ranked)))] for share in (0.5, 0.95, 1.0)]
    text = metres if name.endswith("_m") else "{:.2f}".format
    return " / ".join(text(value) if np.isfinite(value) else "∞" for value in chosen)
