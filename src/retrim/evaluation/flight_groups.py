"""Stores the flights of an unfinished table by groups, so that the same command resumes after being killed."""

from collections.abc import Hashable, Sequence

from ..config.loading import dump
from ..io.digests import tree_digest
from ..runkit.file_digests import file_digests, preset_names, scenario_names
from ..runkit.flight_codec import flight_codec
from ..runkit.flights import Flight, FlightSpec
from ..runkit.provenance import section_key
from ..runkit.reporter import Reporter
from ..runkit.run import PARTS, Run
from .fleet import Fleet

FLIGHTS = f"{PARTS}/flights"
Group = tuple[Hashable, str]
"""A specification's group key; see :attr:`FlightSpec.group`."""


class FlightGroups:
    """The flights of a fleet in a run's store.

    A group contains the flights that one program can fly. It is stored only when it is complete. The batches of other
    groups therefore do not change, and their results stay the same, bit for bit.
    """

    def __init__(self, run: Run, fleet: Fleet, reporter: Reporter) -> None:
        """Read the flights of the same fleet that an earlier run with the same code has stored."""
        self._store, self._pending = run.store(reporter), dict[FlightSpec, Flight]()
        self._groups = dict[Group, list[FlightSpec]]()
        for spec in dict.fromkeys(fleet.specs):  # a method that is listed twice flies once
            self._groups.setdefault(spec.group, []).append(spec)
        policies = {str(seed): tree_digest(policy) for seed, policy in fleet.policies.items()}
        about = {"preset": dump(fleet.preset), "policies": policies, "seconds": fleet.seconds}
        self._keys, self.earlier = dict[Group, str](), dict[FlightSpec, Flight]()
        """``earlier``: flights from an earlier run, which this run does not repeat."""
        for group, specs in self._groups.items():
            scenarios, method = list(dict.fromkeys(spec.scenario for spec in specs)), specs[0].method
            names = [name for scenario in scenarios for name in scenario_names(scenario)]
            files = file_digests(method, *names, *preset_names(fleet.preset))
            inputs = {"scenarios": list(map(repr, scenarios)), "method": method, "flights": len(specs), "files": files}
            self._keys[group] = f"{FLIGHTS}/{section_key(**about, **inputs)}"
            if (flights := self._store.get(self._keys[group], flight_codec(specs))) is not None:
                self.earlier |= {flight.spec: flight for flight in flights}
                run.reused += 1

    def save(self, flights: Sequence[Flight]) -> None:
        """Store each group that is complete with these flights."""
        self._pending |= {flight.spec: flight for flight in flights}
        for group in dict.fromkeys(flight.spec.group for flight in flights):
            specs = self._groups[group]
            if all(spec in self._pending for spec in specs):
                complete = [self._pending.pop(spec) for spec in specs]
                self._store.put(self._keys[group], complete, flight_codec(specs))


def clear_flights(run: Run) -> None:
    """Remove the flights from a run's store, after their table is written."""
    run.store().clear(FLIGHTS)
