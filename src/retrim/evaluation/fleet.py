"""Flies many flights with one preset: scenarios x methods x seeds x starts, on any executor."""

import secrets
import threading
from collections.abc import Callable, Hashable, Mapping, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from typing import Any

from jax import random

from ..adapt.learner_state import LearnerState
from ..config.limits import check_flights, check_seeds
from ..config.loading import dump
from ..config.methods import find_method
from ..config.presets import Preset
from ..config.scenario import Scenario
from ..config.setup import Latency, Setup
from ..errors import ConfigError
from ..progress import show_progress
from ..runkit.compile_cache import release_programs
from ..runkit.flights import Flight, FlightSpec
from ..runkit.flying import fly_batch, fly_one, plant_of, program_of
from .batches import FlightBatch, in_batches, lanes
from .executor import Flights, Progress, Submit, gather_flights, report_progress
from .jobs import Job, fly_job

COMPILATION_END = 1.0  # flight time by which all programs of a batch have run [s]


class Fleet:
    """Flies every combination of scenarios, methods, policies (one per seed) and starts."""

    def __init__(
        self,
        preset: Preset,
        policies: Any,
        scenarios: Sequence[Scenario],
        *,
        methods: Sequence[str] = ("base", "full"),
        starts: int = 8,
        seconds: float | None = None,
        latency: Latency = "fixed",
        state: LearnerState | None = None,
    ) -> None:
        """Plan the flights.

        Args:
            preset: Preset of the policies.
            policies: Policies by seed; a single policy has seed 0. A baseline may have its own network instead.
            scenarios: Scenarios of the flights.
            methods: Methods of the flights.
            starts: Number of flights per scenario, method and seed, each from a different start.
            seconds: Length of a flight [s]; the task's own by default.
            latency: How learning is charged to flight time. ``measured`` flies one flight at a time, so that a flight
                is not charged for another flight's work.
            state: Learner state from an earlier flight; adapting flights resume from it.

        Raises:
            ConfigError: A name does not exist, or two settings are incompatible.
        """
        if not scenarios or not methods:
            raise ConfigError(f"{len(scenarios)} scenarios by {len(methods)} methods: there is nothing to fly")
        check_flights(starts, seconds)
        if vehicles := sorted({s.plant for s in scenarios if s.entry.is_vehicle}):
            raise ConfigError(f"plant {vehicles[0]!r} is a vehicle: use `retrim live`")
        self.preset = preset
        self.policies: dict[int, Any] = dict(policies) if isinstance(policies, Mapping) else {0: policies}
        check_seeds(tuple(self.policies))
        self.setups = {name: Setup.from_preset(preset, name) for name in {s.reference for s in scenarios}}
        for method in methods:  # some methods do not support every task, network or plant
            for setup in self.setups.values():
                setup.pilot(next(iter(self.policies.values())), method, random.key(0))
            if find_method(method).on_board is not None:
                for scenario in scenarios:
                    plant_of(self.setups[scenario.reference], FlightSpec(scenario, method, 0))
        first = next(iter(self.setups.values()))
        self.seconds = first.flight_task.flight_seconds if seconds is None else seconds
        self._latency, self._state, self._id = latency, state, secrets.token_hex(8)
        self._starts = {
            (name, seed): setup.flight_starts(starts, seed)
            for name, setup in self.setups.items()
            for seed in self.policies
        }
        self.specs = [
            FlightSpec(scenario, method, start, seed)
            for scenario in scenarios
            for method in methods
            for seed in self.policies
            for start in range(starts)
        ]

    def make_batches(self, specs: Sequence[FlightSpec]) -> list[FlightBatch]:
        """Return the specifications in batches; flights that cannot share a program run individually."""
        groups: dict[Hashable, list[FlightSpec]] = {}
        for spec in specs:
            groups.setdefault(spec.group, []).append(spec)

        def program(group: list[FlightSpec]) -> Hashable | None:
            setup, policy = self.setups[group[0].scenario.reference], self.policies[group[0].seed]
            return program_of(setup, policy, group) if self._latency == "fixed" else None

        return in_batches(groups.values(), program)

    def warm_up(self, specs: Sequence[FlightSpec] | None = None) -> None:
        """Compile the programs of single flights before take-off, in this process.

        Args:
            specs: The flights; by default all flights of the fleet.
        """
        plants, pilots = set[Scenario](), set[Any]()
        for spec in self.specs if specs is None else specs:
            scenario, kind = spec.scenario, (spec.scenario.reference, spec.method)
            setup, x0 = self.setups[scenario.reference], self._starts[scenario.reference, spec.seed][0]
            if kind not in pilots:
                pilots.add(kind)
                pilot = setup.pilot(self.policies[spec.seed], spec.method, spec.key(), state=self._state)
                with plant_of(setup, spec) as plant:  # its measurements decide which programs the flight needs
                    pilot.warm_up(plant.reset(x0))
            if scenario not in plants:
                plants.add(scenario)
                fly_one(setup, self.policies[spec.seed], spec, x0, 2 * self.preset.dt, state=self._state)

    def run(
        self,
        executor: Executor | None = None,
        *,
        progress: Progress | None = None,
        on_result: Callable[[Sequence[Flight]], None] | None = None,
        stop: threading.Event | None = None,
        only: Sequence[FlightSpec] | None = None,
        by_batch: bool = False,
        forget: bool = False,
    ) -> Flights:
        """Fly all or some of the flights.

        Args:
            executor: Any executor; each of its jobs is a single flight. An executor with other processes builds its own
                programs. Without an executor, flights of a simulated plant run in batches, each as one program, and
                other flights run one by one, on one thread per core.
            progress: Called in this thread when flights are completed, and periodically while they run. By default, a
                notebook or a terminal shows a bar.
            on_result: Receives completed flights, in this thread.
            stop: Aborts the running flights when it is set. Ctrl-C sets it, too.
            only: Fly only these specifications, a part of ``specs``.
            by_batch: Submit batches instead of single flights to an executor with other processes. The flights then
                equal those of the default, bit for bit.
            forget: Do not return the flights, since thousands of logs would fill the memory; ``on_result`` receives
                them.

        Returns:
            The completed flights, in the order of the specifications, and the flights whose jobs failed in another
            process.

        Raises:
            PlantError: A plant refused to fly, or its package is not installed.
        """
        if progress is None:
            with show_progress("flying") as advance:
                advance(0.0, "compiling")
                return self.run(
                    executor, progress=report_progress(advance), on_result=on_result, stop=stop, only=only,
                    by_batch=by_batch, forget=forget,
                )  # fmt: skip
        stop = stop or threading.Event()
        specs = self.specs if only is None else list(only)
        if isinstance(executor, ThreadPoolExecutor):
            batches = [FlightBatch([spec], None) for spec in specs]
            return gather_flights(
                specs,
                batches,
                self._here(executor, stop),
                progress=progress,
                on_result=on_result,
                stop=stop,
                forget=forget,
            )
        if executor is not None:
            batches = self.make_batches(specs) if by_batch else [FlightBatch([spec], None) for spec in specs]
            submit = self._away(executor, keeps_state=not forget)
            return gather_flights(
                specs, batches, submit, progress=progress, on_result=on_result, stop=stop, outlive=True, forget=forget
            )
        batches = self.make_batches(specs)
        self.warm_up([batch.specs[0] for batch in batches if batch.compiled is None])
        with ThreadPoolExecutor(1 if self._latency == "measured" else lanes()) as pool:
            return gather_flights(
                specs, batches, self._here(pool, stop), progress=progress, on_result=on_result, stop=stop, forget=forget
            )

    def _here(self, pool: Executor, stop: threading.Event) -> Submit:
        """Return a function that flies batches in this process."""
        return lambda batch, aloft: pool.submit(self._fly, batch, aloft, stop)

    def _away(self, executor: Executor, *, keeps_state: bool) -> Submit:
        """Return a function that submits batches to an executor with other processes."""
        return lambda batch, aloft: executor.submit(fly_job, self._job(batch.specs, keeps_state))

    def _fly(self, batch: FlightBatch, aloft: Callable[[float], None], stop: threading.Event) -> list[Flight]:
        """Fly a batch in this process; ``aloft`` receives the completed share."""
        first = batch.specs[0]
        setup = self.setups[first.scenario.reference]
        policies = [self.policies[spec.seed] for spec in batch.specs]
        starts = [self._starts[spec.scenario.reference, spec.seed][spec.start] for spec in batch.specs]
        seconds, state = self.seconds, self._state
        if batch.compiled is None:
            alone = fly_one(
                setup, policies[0], first, starts[0], seconds, latency=self._latency, state=state, stop=stop
            )
            return [alone]
        program, cold = batch.compiled, batch.compiles

        def report_share(share: float) -> None:
            if share * seconds > COMPILATION_END:
                program.set()
            aloft(share)

        try:
            if cold:
                release_programs()
            else:
                program.wait()
            return fly_batch(
                setup, policies, batch.specs, starts, seconds, state=state, progress=report_share, stop=stop, cold=cold
            )
        finally:
            program.set()

    def _job(self, specs: Sequence[FlightSpec], keeps_state: bool) -> Job:
        policies = tuple(self.policies[spec.seed] for spec in specs)
        starts = tuple(self._starts[spec.scenario.reference, spec.seed][spec.start] for spec in specs)
        about = self.seconds, self._latency, self._state, keeps_state
        return Job(self._id, dump(self.preset), policies, tuple(specs), starts, *about)
