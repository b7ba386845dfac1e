"""Performs the steps that all tables share: checks the options, trains the policies, and flies them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from jax import random

from ..config.limits import check_flights, check_seeds
from ..config.loading import load_for
from ..config.presets import Preset
from ..config.scenario import Scenario
from ..config.setup import Setup
from ..control.policy import AbstractPolicy
from ..errors import JobError
from ..runkit.reporter import Reporter
from ..runkit.run import Run
from ..runkit.training import nominal_error
from .executor import Flights, report_progress
from .fleet import Fleet
from .flight_groups import FlightGroups
from .policies import train_policies


@dataclass(frozen=True)
class Study:
    """Policies of one preset, one per seed."""

    preset: Preset
    policies: dict[int, Any]
    errors: tuple[float, ...]
    """Error of each policy in its own model [m]."""

    def about(self) -> str:
        """Return one line of text about the policies."""
        own = ", ".join(f"{1000 * error:.1f}" for error in self.errors)
        return f"Preset `{self.preset.name}`; error in its own model, by seed: {own} mm."


def table_presets(
    names: Sequence[str], task: str, *, seeds: Sequence[int], starts: int, seconds: float | None
) -> list[Preset]:
    """Load a table's presets, and check its seeds, starts and flight length before any training.

    Raises:
        ConfigError: A preset does not exist or is for a different task, or a value is out of range.
    """
    check_seeds(seeds)
    check_flights(starts, seconds)
    return [load_for(task, name) for name in names]


def train_all(preset: Preset, seeds: Sequence[int], run: Run, reporter: Reporter) -> Study:
    """Train a policy for each seed, or read it from the run; after an interruption, return the completed ones."""
    setup, policies, errors = Setup.from_preset(preset), dict[int, AbstractPolicy](), list[float]()
    for seed, policy in train_policies(preset, seeds, run, reporter).items():
        if run.interrupted:
            break
        with run.interruptible():
            errors.append(nominal_error(setup, policy))
            policies[seed] = policy
    return Study(preset, policies, tuple(errors))


def refuse_misfits(
    preset: Preset, scenarios: Sequence[Scenario], *, methods: Sequence[str], starts: int, seconds: float | None
) -> None:
    """Plan a table's flights with an untrained policy.

    Raises:
        ConfigError: A name does not exist, or two settings are incompatible.
        PlantError: A plant's package is not installed.
    """
    for scenario in scenarios:
        scenario.make(preset.vehicle, dt=preset.dt)
    untrained_policy = Setup.from_preset(preset).new_policy(random.key(0))
    Fleet(preset, untrained_policy, scenarios, methods=methods, starts=starts, seconds=seconds)


def fly_all(
    study: Study,
    scenarios: Sequence[Scenario],
    run: Run,
    reporter: Reporter,
    *,
    methods: Sequence[str] = ("base", "full"),
    starts: int,
    seconds: float | None,
    keep: bool = True,
) -> Flights:
    """Fly every combination, and report the progress.

    Args:
        study: Policies to fly.
        scenarios: Scenarios of the flights.
        run: Run whose folder stores the flights; flights that an earlier run has stored there are not repeated.
        reporter: Receives the progress.
        methods: Methods of the flights.
        starts: Number of flights per scenario, method and seed.
        seconds: Length of a flight [s]; the task's own by default.
        keep: Store the flights until the table removes them; learner states are not stored.

    Raises:
        PlantError: A plant's package is not installed.
        JobError: Flights failed in another process; an incomplete table is not written.
    """
    if not study.policies or run.interrupted:
        return Flights([], interrupted=True)
    fleet = Fleet(study.preset, study.policies, scenarios, methods=methods, starts=starts, seconds=seconds)
    groups = FlightGroups(run, fleet, reporter) if keep else None
    earlier = {} if groups is None else groups.earlier
    left = [spec for spec in fleet.specs if spec not in earlier]
    if earlier:
        reporter.say(f"{len(earlier)} of {len(fleet.specs)} flights are taken from an earlier run in this folder")
    flights = Flights([], interrupted=bool(left))
    if left:
        with run.interruptible(), reporter.progress("flying") as advance:
            advance(0.0, "compiling the programs of a flight (kept in a cache for the next time)")
            flights = fleet.run(
                run.executor,
                stop=run.stop,
                progress=report_progress(advance),
                on_result=None if groups is None else groups.save,
                only=left,
                by_batch=True,
            )
    if flights.failed:
        why = next(iter(flights.failed.values()))
        raise JobError(
            f"{len(flights.failed)} of {len(fleet.specs)} flights failed in other processes, the first with {why}"
        )
    by_spec = earlier | {flight.spec: flight for flight in flights.flights}
    return replace(flights, flights=[by_spec[spec] for spec in fleet.specs if spec in by_spec])
