"""What every table does: train policies, fly them, lay methods and disturbances out as the paper does."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from ...config.loading import load_for
from ...config.methods import find_method
from ...config.presets import Preset
from ...config.scenario import Scenario
from ...config.setup import Setup
from ...control.policy import Policy
from ..figures import picture
from ..fleet import Fleet, Flights
from ..limits import check_flights, check_seeds
from ..metrics import cell, rows
from ..reporter import Reporter
from ..run import Run
from ..training import nominal_error, train
from .document import TableSection

LEVELS = ("none", "small", "large")
COLUMNS = ("error [m]", "no disturbance", "small, 0.5 m/s² per axis", "large, 2 m/s² per axis")
PaperRows = tuple[tuple[str, tuple[str, str, str]], ...]
"""Label and figures of the paper for the three levels [m]."""


@dataclass(frozen=True)
class Study:
    """Policies of one preset, one per seed."""

    preset: Preset
    policies: dict[int, Policy]
    errors: tuple[float, ...]
    """Error of each in its own model [m]."""

    def about(self) -> str:
        """Return one sentence on the policies."""
        own = ", ".join(f"{1000 * error:.1f}" for error in self.errors)
        return f"Preset `{self.preset.name}`; error in its own model, by seed: {own} mm."


def table_presets(
    names: Sequence[str], task: str, *, seeds: Sequence[int], starts: int, seconds: float | None
) -> list[Preset]:
    """Load the presets of a table, and check its sizes before anything is trained.

    Raises:
        ConfigError: A preset does not exist or is for another task, or the sizes cannot be flown.
    """
    check_seeds(seeds)
    check_flights(starts, seconds)
    return [load_for(task, name) for name in names]


def train_all(preset: Preset, seeds: Sequence[int], run: Run, reporter: Reporter) -> Study:
    """Train a policy for each seed; an interruption leaves those that are complete."""
    setup, policies, errors = Setup.of(preset), dict[int, Policy](), list[float]()
    for seed in seeds:
        if run.interrupted:
            break
        reporter.say(f"preset {preset.name}, seed {seed}")
        policy, _ = train(setup, seed, reporter=reporter, stop=run.stop)
        if not run.interrupted:
            with run.interruptible():
                errors.append(nominal_error(setup, policy))
                policies[seed] = policy
    return Study(preset, policies, tuple(errors))


def fly_all(
    study: Study,
    scenarios: Sequence[Scenario],
    run: Run,
    reporter: Reporter,
    *,
    methods: Sequence[str] = ("base", "full"),
    starts: int,
    seconds: float | None,
) -> Flights:
    """Fly every combination, with progress.

    Raises:
        PlantError: The package of a plant is not installed.
    """
    if not study.policies or run.interrupted:
        return Flights([], interrupted=True)
    fleet = Fleet(study.preset, study.policies, scenarios, methods=methods, starts=starts, seconds=seconds)
    with run.interruptible(), reporter.progress("flying") as advance:
        advance(0.0, "compiling the programs of a flight (kept in a cache for the next time)")
        fleet.warm_up()
        return fleet.run(stop=run.stop, progress=lambda done, n: advance(done / n, f"{done} of {n} flights"))
    return Flights([], interrupted=True)


def level_section(
    study: Study,
    title: str,
    base: Scenario,
    run: Run,
    reporter: Reporter,
    *,
    methods: Sequence[str] = ("base", "full"),
    starts: int,
    seconds: float | None,
    paper: PaperRows = (),
    stem: str | None = None,
) -> tuple[TableSection, list[dict[str, Any]]] | None:
    """Fly the paper's three levels of disturbance and lay them out: methods down, levels across.

    Returns:
        The section and its rows of results; None if nothing was flown.
    """
    scenarios = [replace(base, disturbance=level) for level in LEVELS]
    flown = fly_all(study, scenarios, run, reporter, methods=methods, starts=starts, seconds=seconds).flown
    if not flown:
        return None
    found = [{**row, "preset": study.preset.name, "section": title} for row in rows(flown)]
    kinds = [event.kind for flight in flown for event in flight.events]
    crashed = sum(flight.log.terminated for flight in flown)
    about = (
        f"{study.about()} The gate admitted {kinds.count('policy')} policies and refused {kinds.count('rejected')}. "
        f"{crashed} of {len(flown)} flights crashed."
    )
    setup = Setup.of(study.preset, base.reference)
    first = [f for f in flown if f.spec.seed == flown[0].spec.seed and f.spec.method in ("base", "full")]
    drawn = picture(first, setup, scenarios[-1], run.folder, stem=stem)
    table = level_table(found, methods, paper, title)
    return replace(table, about=about, picture=drawn[0] if drawn else None), found


def level_table(found: Sequence[dict[str, Any]], methods: Sequence[str], paper: PaperRows, title: str) -> TableSection:
    """Lay rows of results out as the paper does: methods down, levels of disturbance across, its own rows below."""
    by = {(row["method"], row["disturbance"]): row for row in found}
    cells = list[tuple[str, ...]]()
    for method in methods:
        ours = [by.get((method, level)) for level in LEVELS]
        cells.append((find_method(method).label, *("-" if row is None else cell(row) for row in ours)))
        cross = ["-" if row is None or "cross_track_m" not in row else f"{row['cross_track_m']:.3f}" for row in ours]
        if set(cross) != {"-"}:
            cells.append(("... cross-track", *cross))
    cells += [(f"paper, {label}", *figures) for label, figures in paper]
    return TableSection(COLUMNS, tuple(cells), title)
