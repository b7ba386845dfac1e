"""Many flights of one preset: scenarios x methods x seeds x starts, on any executor."""

import dataclasses
import secrets
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from typing import Any

from jax import random

from ..adapt.learner import LearnerState
from ..config.loading import dump
from ..config.presets import Preset
from ..config.scenario import Scenario
from ..config.setup import Latency, Setup
from ..control.policy import Policy
from ..errors import ConfigError
from ..plants.plant import Measurement
from ..runtime.flight import FlightStopped
from .flights import Flight, FlightSpec, fly_one
from .interrupts import interrupts_only_set
from .jobs import Job, fly_job
from .limits import check_flights, check_seeds
from .metrics import Rows, rows
from .provenance import cores

Progress = Callable[[int, int], None]
"""Called with the number of flights that are over, and of all flights."""


@dataclass(frozen=True)
class Flights:
    """The flights of a fleet that were flown to their end."""

    flown: list[Flight]
    interrupted: bool
    """Some flights are missing: the fleet was stopped."""

    def rows(self) -> Rows:
        """Return one row of results per scenario, method and seed."""
        return rows(self.flown)


class Fleet:
    """Flies every combination of scenarios, methods, policies (one per seed) and starts."""

    def __init__(
        self,
        preset: Preset,
        policies: Policy | Mapping[int, Policy],
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
            policies: By seed; a single one has the seed 0.
            scenarios: Where they fly.
            methods: How they fly.
            starts: Flights per scenario, method and seed, each from another start.
            seconds: Length of a flight; the task's own by default.
            latency: What learning costs in flight time. ``measured`` flies one flight at a time, so that none is
                charged for another's work.
            state: What an earlier flight learnt; adapting flights go on from it.

        Raises:
            ConfigError: Something does not exist, or does not fit together.
        """
        if not scenarios or not methods:
            raise ConfigError(f"{len(scenarios)} scenarios by {len(methods)} methods: there is nothing to fly")
        check_flights(starts, seconds)
        self.preset = preset
        self.policies = dict(policies) if isinstance(policies, Mapping) else {0: policies}
        check_seeds(tuple(self.policies))
        self.setups = {name: Setup.of(preset, name) for name in {s.reference for s in scenarios}}
        for method in methods:
            for setup in self.setups.values():  # some do not fit every task or network
                setup.pilot(next(iter(self.policies.values())), method, random.key(0))
        first = next(iter(self.setups.values()))
        self.seconds = first.flown.flight_seconds if seconds is None else seconds
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

    def warm_up(self) -> None:
        """Compile every program of the flights before the first take-off, in this process."""
        plants, pilots = set[Scenario](), set[Any]()
        for spec in self.specs:
            scenario, kind = spec.scenario, (spec.scenario.reference, spec.method)
            setup, x0 = self.setups[scenario.reference], self._starts[scenario.reference, spec.seed][0]
            if kind not in pilots:
                pilots.add(kind)
                pilot = setup.pilot(self.policies[spec.seed], spec.method, spec.key(), state=self._state)
                pilot.warm_up(Measurement(0.0, x0))
            if scenario not in plants:
                plants.add(scenario)
                short = dataclasses.replace(spec, method="base")
                fly_one(setup, self.policies[spec.seed], short, x0, 2 * self.preset.dt)

    def run(
        self,
        executor: Executor | None = None,
        *,
        progress: Progress | None = None,
        stop: threading.Event | None = None,
        only: Sequence[FlightSpec] | None = None,
    ) -> Flights:
        """Fly.

        Args:
            executor: Any executor; by default one thread per core. One with other processes builds its own programs.
            progress: Called in this thread when a flight is over.
            stop: Gives up what is flying. Ctrl-C does the same, and sets it.
            only: Fly these specifications, a part of ``specs``.

        Returns:
            The flights that were flown to their end, in the order of the specifications.

        Raises:
            PlantError: A plant refused, or its package is not installed.
        """
        stop = stop or threading.Event()
        specs = self.specs if only is None else list(only)
        if executor is not None:
            return self._run(executor, specs, progress, stop, shared=isinstance(executor, ThreadPoolExecutor))
        with ThreadPoolExecutor(1 if self._latency == "measured" else cores()) as pool:
            return self._run(pool, specs, progress, stop, shared=True)

    def _run(
        self,
        executor: Executor,
        specs: Sequence[FlightSpec],
        progress: Progress | None,
        stop: threading.Event,
        *,
        shared: bool,
    ) -> Flights:
        futures: dict[FlightSpec, Future[Flight]] = {}
        try:
            for spec in specs:
                futures[spec] = (
                    self._submit(executor, spec, stop) if shared else executor.submit(fly_job, self._job(spec))
                )
            for done, future in enumerate(as_completed(futures.values()), start=1):
                future.result()
                if progress is not None:
                    progress(done, len(specs))
        except (KeyboardInterrupt, FlightStopped):
            stop.set()
        except BaseException:
            stop.set()
            raise
        finally:
            with interrupts_only_set(stop):  # a further Ctrl-C must not lose what is done
                for future in futures.values():
                    future.cancel()
                if stop.is_set():
                    for future in futures.values():
                        if not future.cancelled():
                            future.exception()
        over = [futures[spec] for spec in specs if spec in futures]
        flown = [f.result() for f in over if f.done() and not f.cancelled() and f.exception() is None]
        return Flights(flown, interrupted=len(flown) < len(specs))

    def _submit(self, executor: Executor, spec: FlightSpec, stop: threading.Event) -> Future[Flight]:
        """Let a thread of this process fly."""
        return executor.submit(
            fly_one,
            self.setups[spec.scenario.reference],
            self.policies[spec.seed],
            spec,
            self._starts[spec.scenario.reference, spec.seed][spec.start],
            self.seconds,
            latency=self._latency,
            state=self._state,
            stop=stop,
        )

    def _job(self, spec: FlightSpec) -> Job:
        x0 = self._starts[spec.scenario.reference, spec.seed][spec.start]
        policy, preset = self.policies[spec.seed], dump(self.preset)
        return Job(self._id, preset, policy, spec, x0, self.seconds, self._latency, self._state)
