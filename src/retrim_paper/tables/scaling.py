"""Measures how time and memory grow with the number of flights."""

import pickle
import resource
import sys
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from retrim.config.limits import check_flights
from retrim.config.scenario import Scenario
from retrim.errors import ConfigError
from retrim.evaluation.batches import CPU_LIMIT
from retrim.evaluation.executor import report_progress
from retrim.evaluation.fleet import Fleet
from retrim.evaluation.study import refuse_misfits, table_presets, train_all
from retrim.runkit.document import Document, TableSection
from retrim.runkit.flights import Flight
from retrim.runkit.reporter import Reporter
from retrim.runkit.run import Run
from retrim.runkit.stopwatch import Stopwatch
from retrim.viz.panels import Curve, Panel, panel_figure
from retrim.viz.plots import save

CONDITIONS = ("gusts", "payload")
METHODS = ("base", "full")
FLIGHTS_PER_SEED = len(CONDITIONS) * len(METHODS)
TOTAL, MACHINES = 1_000_000, (1, 3, 10, 30, 100, 300, 1000)
LINK, JOB_S = 117e6, 1e-3  # [bytes/s], [s], both assumed
COLUMNS = (
    "flights",
    "compiling [s]",
    "flying [s]",
    "flights a second",
    "seconds of flight a second",
    "peak memory [MB]",
)


def scaling(
    run: Run,
    reporter: Reporter,
    *,
    preset: str = "hover/retrim",
    flights: tuple[int, ...] = (12, 40, 120, 400, 1000),
    seconds: float = 12.0,
) -> None:
    """From a dozen to ten thousand flights: the time, the flights per second, the memory, and their growth.

    Args:
        run: Folder for scaling.md, scaling.json and the picture.
        reporter: Receives progress and the table.
        preset: Preset for hover, with which the policy is trained.
        flights: Numbers of flights, each a multiple of four. Half of the flights adapt; half fly in gusts, and half
            with a load.
        seconds: Length of a flight [s].
    """
    (base,) = table_presets([preset], "hover", seeds=(0,), starts=1, seconds=seconds)
    for n in flights or (0,):
        if n < FLIGHTS_PER_SEED or n % FLIGHTS_PER_SEED:
            raise ConfigError(f"--flights {n} must be a positive multiple of {FLIGHTS_PER_SEED}")
        check_flights(n // FLIGHTS_PER_SEED, seconds)
    scenarios = [Scenario(name) for name in CONDITIONS]
    refuse_misfits(base, scenarios, methods=METHODS, starts=1, seconds=seconds)
    intro = (
        f"Made by `retrim reproduce scaling`: flights of {seconds:g} s on plant `bem` in gusts or "
        "with a load, half of them adapting twice a second, in batches of at most 64 on each core; flights are "
        "scored when they end, and not stored. Compiling: programs that were not in the compile cache of the machine; "
        "flights on another core during that time count as compiling, so that the stated rate of flights is too large "
        "if much was compiled. Memory: the largest memory of the process until then."
    )
    document = Document(run, "scaling", "Flights by the thousand", intro, [0], reporter)
    study = train_all(base, (0,), run, reporter)
    rows, sizes = list[dict[str, Any]](), list[int]()
    for n in flights if study.policies else ():
        if run.interrupted:
            break
        fleet = Fleet(base, study.policies, scenarios, methods=METHODS, starts=n // FLIGHTS_PER_SEED, seconds=seconds)
        watch, errors = Stopwatch(), list[float]()

        def note(on_result: Sequence[Flight], errors: list[float] = errors) -> None:
            errors += [flight.steady for flight in on_result]
            sizes.append(len(pickle.dumps(replace(on_result[0], learner_state=None))))

        with run.interruptible(), reporter.progress(f"{n} flights") as advance:
            fleet.run(
                stop=run.stop,
                progress=report_progress(advance),
                on_result=note,
                forget=True,
            )
        if not run.interrupted and errors:
            rows.append(_row(n, seconds, watch, errors) | {"flight_bytes": max(sizes)})
            run.write_results(rows, seeds=[0], name="scaling")
    if rows:
        document.add(_section(rows, run), rows)
        document.add(_on_machines(rows))
    document.write()


def _on_machines(rows: Sequence[dict[str, Any]]) -> TableSection:
    """Extrapolate to many machines with a model of four numbers, two of which are measured."""
    last = rows[-1]
    per_flight, size, compiling = last["run_s"] / last["flights"], last["flight_bytes"], rows[0]["compile_s"]
    lines = []
    for m in MACHINES:
        bounds = {
            "flying": TOTAL * per_flight / m,
            "the client's network": TOTAL * size / LINK,
            "the scheduler": TOTAL / CPU_LIMIT * JOB_S,
        }
        most = max(bounds, key=lambda name: bounds[name])
        lines.append((f"{m}", _time(compiling + bounds[most]), most))
    about = (
        f"Not measured, but computed: {TOTAL:,} such flights on this number of machines of this kind, with a Dask "
        f"scheduler. Time = compiling ({compiling:.0f} s, on all machines at once, as measured above) + the largest "
        f"of: flying ({1e3 * per_flight:.0f} ms a flight, measured above, divided by the machines); the network of "
        f"the client, who receives {size / 1e3:.0f} kB a flight (measured) at {LINK / 1e6:.0f} MB/s (assumed, a "
        f"gigabit); the scheduler, at {1e3 * JOB_S:.0f} ms a job of {CPU_LIMIT} flights (assumed). Training, slow "
        "machines and lost machines are not included. Beyond the network's limit, more machines do not help; several "
        "clients help, each with a part of the seeds."
    )
    return TableSection(("machines", "time", "what takes longest"), tuple(lines), "On more machines", about)


def _time(seconds: float) -> str:
    for unit, size in (("days", 86_400.0), ("hours", 3600.0), ("minutes", 60.0)):
        if seconds >= 2.0 * size:
            return f"{seconds / size:.1f} {unit}"
    return f"{seconds:.0f} s"


def _row(n: int, seconds: float, watch: Stopwatch, errors: Sequence[float]) -> dict[str, Any]:
    unit = 1024.0 if sys.platform != "darwin" else 1024.0**2
    compile_s = watch.compile_s
    return {
        "flights": n,
        "seconds": seconds,
        "compile_s": compile_s,
        "run_s": watch.total_s - compile_s,
        "peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit,
        "crashes": int(np.isnan(errors).sum()),
        "mean": float(np.nanmean(errors)) if np.isfinite(errors).any() else None,
    }


def _section(rows: Sequence[dict[str, Any]], run: Run) -> TableSection:
    n, took, memory = (np.array([row[key] for row in rows]) for key in ("flights", "run_s", "peak_mb"))
    lines = tuple(
        (
            f"{row['flights']}",
            f"{row['compile_s']:.0f}",
            f"{row['run_s']:.1f}",
            f"{row['flights'] / row['run_s']:.1f}",
            f"{row['flights'] * row['seconds'] / row['run_s']:.0f}",
            f"{row['peak_mb']:.0f}",
        )
        for row in rows
    )
    linear = took[-1] * n / n[-1]
    panels = [
        Panel(
            "flying",
            "flights",
            "s",
            [Curve(n, took, "measured"), Curve(n, linear, "in proportion", dashed=True)],
            log=True,
        ),
        Panel("peak memory", "flights", "MB", [Curve(n, memory, "measured")], log=True),
    ]
    picture_path = save(panel_figure("Flights by the thousand", panels, across=2), run.folder, "scaling")
    crashes = sum(row["crashes"] for row in rows)
    about = f"{crashes} of {int(n.sum())} flights crashed."
    return TableSection(COLUMNS, lines, about=about, picture=picture_path[0])
