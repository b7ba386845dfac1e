"""Makes the table of hover under a push that reverses every 15 s (Sec. IV-B.3 of the paper)."""

from pathlib import Path
from typing import Any

import numpy as np

from retrim.config.presets import Adapt
from retrim.config.scenario import Scenario
from retrim.config.setup import Setup
from retrim.errors import ConfigError
from retrim.evaluation.figures import picture
from retrim.evaluation.flight_groups import clear_flights
from retrim.evaluation.metrics import mean_and_deviation, metres, rows
from retrim.evaluation.study import fly_all, table_presets, train_all
from retrim.runkit.document import Document, TableSection
from retrim.runkit.flights import Flight
from retrim.runkit.reporter import Reporter
from retrim.runkit.run import Run

PERIOD = 15.0  # [s]
MOST_UPDATES = 6  # largest number of updates that each have a column
METHODS: dict[str, str] = {
    "base": "base policy",
    "base-i": "integral action",
    "base-do": "disturbance observer",
    "geometric-i": "geometric controller, integral action",
    "indi": "INDI",
    "full": "**adapted**",
}
INTRO = """\
Made by `retrim reproduce reversing`. ±0.5 m/s² on each axis, reversed every 15 s. Mean error [m] over a second, or
over the time between two updates if that is less: before the reversal, before the next update takes effect, and
before later ones or the next reversal (of many, the 1st, 2nd, 4th, 8th and so on); mean ± standard deviation over
flights. The first update that takes effect after a reversal was still computed before it. Learning is charged to
flight time by the preset's fixed latencies."""


def reversing(
    run: Run,
    reporter: Reporter,
    *,
    preset: str = "hover/retrim",
    plant: str = "bem",
    seeds: tuple[int, ...] = (0,),
    seconds: float = 60.0,
    starts: int = 8,
) -> None:
    """Hover under a push that reverses every 15 s: the error before and after each update, and a picture.

    Args:
        run: Folder for reversing.md, reversing.json and the picture.
        reporter: Receives progress and the section.
        preset: Preset for hover, with which the policy is trained.
        plant: Plant for the flights.
        seeds: Training seeds.
        seconds: Length of a flight [s].
        starts: Flights per method and seed.
    """
    (base,) = table_presets([preset], "hover", seeds=seeds, starts=starts, seconds=seconds)
    scenario = Scenario("reversing", plant=plant)
    if seconds < 2 * PERIOD:
        raise ConfigError(f"flights of {seconds:g} s: a push that reverses needs at least {2 * PERIOD:g} s")
    document = Document(
        run, "reversing", "Hover under a push that reverses (Sec. IV-B.3 of the paper)", INTRO, seeds, reporter
    )
    study = train_all(base, seeds, run, reporter)
    flights = fly_all(study, [scenario], run, reporter, methods=tuple(METHODS), starts=starts, seconds=seconds).flights
    if not flights:
        document.write()
        return
    moments, updates = _moments(base.adapt, seconds)
    span = min(1.0, base.adapt.update_every)
    errors: dict[str, list[np.ndarray]] = {
        m: [_errors(f, moments, span) for f in flights if f.spec.method == m and not f.log.terminated] for m in METHODS
    }
    result = rows(flights)
    peaks = "; ".join(f"{METHODS[row['method']].strip('*')} {_peak(row)}" for row in result)
    crashes = sum(row["crashes"] for row in result)
    about = f"{study.about()} Median of the largest error after 5 s [m]: {peaks}. "
    about += f"{crashes} of {len(flights)} flights crashed."
    drawn_flights = [f for f in flights if f.spec.method in ("base", "full")]
    picture_path = picture(drawn_flights, Setup.from_preset(base), scenario, run.folder)
    document.more = {"moments_s": moments.tolist(), "errors_m": {m: np.array(e).tolist() for m, e in errors.items()}}
    document.add(_section(errors, moments, updates, about, picture_path[0] if picture_path else None), result)
    if not run.interrupted:
        clear_flights(run)


def _peak(row: dict[str, Any]) -> str:
    return "-" if row["peak_after_5s"] is None else metres(row["peak_after_5s"])


def _moments(adapt: Adapt, seconds: float) -> tuple[np.ndarray, list[int]]:
    """Return the times at which errors are read [s], and the update numbers.

    Each row belongs to a reversal: its time, the times at which the updates take effect, and the end of the period.
    """
    turns = np.arange(PERIOD, seconds - PERIOD / 2, PERIOD)
    swaps = np.arange(adapt.update_latency, PERIOD, adapt.update_every)
    updates = list(range(len(swaps)))
    if len(swaps) > MOST_UPDATES:
        updates = [0, *(2**k for k in range(len(swaps)) if 2**k < len(swaps))]
    after = np.concatenate([[0.0], swaps[updates], [PERIOD]])
    moments: np.ndarray = np.minimum(turns[:, None] + after[None], seconds)
    return moments, [*updates[1:], len(swaps)]


def _errors(flight: Flight, moments: np.ndarray, span: float = 1.0) -> np.ndarray:
    """Return the mean error over the last ``span`` seconds before each moment [m]."""
    t = flight.log.t
    result = [flight.error[(t > end - span) & (t <= end + 1e-6)].mean() for end in moments.flat]
    return np.array(result).reshape(moments.shape)


def _section(
    errors: dict[str, list[np.ndarray]], moments: np.ndarray, updates: list[int], about: str, picture_path: Path | None
) -> TableSection:
    lines = list[tuple[str, ...]]()
    for i, reversal in enumerate(moments[:, 0]):
        for method, name in METHODS.items():
            table = [result[i] for result in errors[method]]
            columns = np.array(table).T  # empty if no flight finished
            cells = [mean_and_deviation(column) for column in columns]
            cells = cells or ["-"] * moments.shape[1]
            lines.append((f"reversed at {reversal:g} s, {name}", *cells))
    columns_ = ("", "just before it", "before an update takes effect", *(f"after update {i}" for i in updates))
    return TableSection(columns_, tuple(lines), "", about, picture_path)
