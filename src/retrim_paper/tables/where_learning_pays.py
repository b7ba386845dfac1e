"""Makes the page that states in which regimes learning in flight pays, and in which it does not."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from retrim.config.limits import check_seeds
from retrim.config.loading import dump
from retrim.errors import ConfigError
from retrim.evaluation.flight_groups import clear_flights
from retrim.evaluation.study import Study, fly_all, refuse_misfits, train_all
from retrim.runkit.document import Document, TableSection
from retrim.runkit.flights import Flight
from retrim.runkit.reporter import Reporter
from retrim.runkit.run import Run

from ..regimes import Regime, regimes

OPPONENTS: dict[str, tuple[str, ...]] = {
    "base": ("base",),
    "observer": ("base-do",),
    "geometric + I": ("geometric-i",),
    "INDI": ("indi",),
    "INDI, wrong by two": ("indi-half", "indi-double"),
    "MPPI + L1": ("l1-mpc",),
}
"""Methods of each column; with several methods, the cell shows the worst one."""
ADAPTED_COLUMN, OPPONENT_COLUMNS = "adapted", ("observer", "geometric + I", "INDI", "MPPI + L1")
TIE = 1e-3  # [m]; smaller differences are ties
CLEAR_RATIO = 0.7  # an error below this ratio of another one is better
SAMPLING, SAMPLING_STARTS = ("l1-mpc",), 2
"""Methods with thousands of predictions per command, and their largest number of starts per seed. All starts would take
as long as all other methods together."""
INTRO = """\
Made by `retrim reproduce where_learning_pays`. Each row is a regime; each cell is the median over flights [mm, lap
times in ms], with the 95 % interval of the median (bootstrap over flights) in brackets, and the number of lost
flights, which count as infinite. The disturbance is unknown to all methods. "INDI, wrong by two": INDI that assumes
half or twice the thrust per command, the worse of the two. "MPPI + L1" flies at most two starts per seed; all starts
would take as long as all other methods together. "adapted": learned in flight, charged to flight time by the
preset's fixed latencies; in the rows S1 to S3 and "many vehicles", one policy for many vehicles with identification
(`base-id`), and otherwise all weights (`full`). The verdict follows from the numbers: learning pays if the adapted
flights have less than 0.7 times the error of the best other method (observer, geometric + I, INDI, MPPI + L1) among
those that lost no larger share of their flights, and by more than 1 mm; it is a tie within 1 mm; otherwise the best
other method is named."""


def where_learning_pays(
    run: Run,
    reporter: Reporter,
    *,
    only: tuple[str, ...] = (),
    columns: tuple[str, ...] = tuple(OPPONENTS),
    seeds: tuple[int, ...] = (0, 1, 2),
    starts: int = 8,
) -> None:
    """In which regimes learning in flight pays, with strong opponents: one row per regime, one verdict per row.

    Args:
        run: Folder for where_learning_pays.md and where_learning_pays.json.
        reporter: Receives progress and the table.
        only: Names, or beginnings of names, of the rows to make; all by default.
        columns: Columns of opponents.
        seeds: Training seeds; each also seeds the starts, gusts and learners of its flights.
        starts: Flights per row, method and seed; at most two of them with MPPI.
    """
    check_seeds(seeds)
    selection = [row for row in regimes() if not only or row.name.startswith(only)]
    if not selection:
        raise ConfigError(f"no row {only[0]!r}; there are {', '.join(row.name for row in regimes())}")
    if unknown := [name for name in columns if name not in OPPONENTS]:
        raise ConfigError(f"no column {unknown[0]!r}; there are {', '.join(OPPONENTS)}")
    for row in selection:
        options: dict[str, Any] = {"methods": _methods(row, columns), "starts": starts, "seconds": row.seconds}
        refuse_misfits(row.preset, row.scenarios[:1], **options)
    document = Document(run, "where_learning_pays", "Where learning pays", INTRO, seeds, reporter)
    lines, results = list[tuple[str, ...]](), list[dict[str, Any]]()
    studies = dict[str, Study]()
    for row in selection:
        if run.interrupted:
            break
        reporter.say(f"{row.name}: {row.about}")
        key = dump(row.preset)
        if key not in studies:
            studies[key] = train_all(row.preset, seeds, run, reporter)
        if (flights := _fly(row, studies[key], _methods(row, columns), starts, run, reporter)) is None:
            break
        line, rows = _line(row, flights, columns)
        lines.append(line)
        results += rows
    head = ("regime", "condition", "score", *columns, ADAPTED_COLUMN, "published", "verdict")
    document.add(TableSection(head, tuple(lines)), results)
    if not run.interrupted:
        clear_flights(run)


def _fly(
    row: Regime, study: Study, methods: Sequence[str], starts: int, run: Run, reporter: Reporter
) -> list[Flight] | None:
    """Return the flights of a row; None if they were interrupted."""
    sampling = [method for method in methods if method in SAMPLING]
    others = [method for method in methods if method not in SAMPLING]
    flights = list[Flight]()
    for group, number in ((others, starts), (sampling, min(starts, SAMPLING_STARTS))):
        if not group:
            continue
        new = fly_all(study, row.scenarios, run, reporter, methods=group, starts=number, seconds=row.seconds)
        if new.interrupted:
            return None
        flights += new.flights
    return flights


def _methods(row: Regime, columns: Sequence[str]) -> tuple[str, ...]:
    """Return the methods of a row, each once."""
    opponents = [method for column in columns for method in OPPONENTS[column]]
    return tuple(dict.fromkeys([*opponents, row.adapted]))


def _line(
    row: Regime, flights: Sequence[Flight], columns: Sequence[str]
) -> tuple[tuple[str, ...], list[dict[str, Any]]]:
    """Return the cells of a row, and the scores of its flights."""
    scores = {method: _scores(row, flights, method) for method in _methods(row, columns)}
    cells = dict[str, str]()
    medians = dict[str, float]()
    for column in columns:
        worst = max(OPPONENTS[column], key=lambda method: (float(np.median(scores[method])), np.sum(scores[method])))
        cells[column], medians[column] = _cell(scores[worst]), float(np.median(scores[worst]))
    cells[ADAPTED_COLUMN], medians[ADAPTED_COLUMN] = _cell(scores[row.adapted]), float(np.median(scores[row.adapted]))
    verdict = decide(medians, {name: _lost_share(scores, name, row) for name in medians})
    line = (row.name, row.about, row.score.about, *cells.values(), row.published, verdict)
    rows = [
        {"regime": row.name, "method": method, "score_m": [value if np.isfinite(value) else None for value in values]}
        for method, values in scores.items()
    ]
    return line, rows


def _scores(row: Regime, flights: Sequence[Flight], method: str) -> np.ndarray:
    own = [flight for flight in flights if flight.spec.method == method]
    return np.array([np.inf if flight.log.terminated else row.score.of(flight) for flight in own])


def _lost_share(scores: dict[str, np.ndarray], name: str, row: Regime) -> float:
    methods = (row.adapted,) if name == ADAPTED_COLUMN else OPPONENTS[name]
    return max(float(np.mean(np.isinf(scores[method]))) for method in methods)


def _cell(scores: np.ndarray) -> str:
    """Return the median [mm], its bootstrap interval, and the number of lost flights."""
    losses = int(np.sum(np.isinf(scores)))
    draw = np.random.default_rng(0)
    medians = np.median(scores[draw.integers(0, len(scores), (1000, len(scores)))], axis=1)
    low, high = np.quantile(medians, [0.025, 0.975], method="nearest")
    text = f"{_mm(float(np.median(scores)))} ({_mm(float(low))} to {_mm(float(high))})"
    return f"{text}, {losses} of {len(scores)} lost" if losses else text


def _mm(metres: float) -> str:
    if not np.isfinite(metres):
        return "∞"
    value = 1000.0 * metres
    return f"{value:.2f}" if value < 1.0 else f"{value:.1f}" if value < 100.0 else f"{value:.0f}"


def decide(medians: dict[str, float], losses: dict[str, float]) -> str:
    """Return the verdict for a row.

    Args:
        medians: Median score of each column [m]; infinite if most flights were lost.
        losses: Share of lost flights of each column.
    """
    rivals = {name: medians[name] for name in OPPONENT_COLUMNS if name in medians}
    if not rivals:
        return "no opponent was flown"
    fewest = min(losses[name] for name in rivals)
    if losses[ADAPTED_COLUMN] > fewest:
        best = min((name for name in rivals if losses[name] == fewest), key=lambda name: rivals[name])
        return f"use {best} here: adapted flights are lost"
    safe = {name: value for name, value in rivals.items() if losses[name] == losses[ADAPTED_COLUMN]}
    if not safe:
        return "learning pays: every opponent loses flights"
    best = min(safe, key=lambda name: safe[name])
    gain = safe[best] - medians[ADAPTED_COLUMN]
    if abs(gain) <= TIE:
        return f"a tie: {best} is as good and simpler"
    if medians[ADAPTED_COLUMN] < CLEAR_RATIO * safe[best]:
        return f"learning pays: {safe[best] / max(medians[ADAPTED_COLUMN], 1e-6):.1f} times less error than {best}"
    return f"use {best} here" if gain < 0.0 else f"learning helps a little; {best} is simpler"
