"""Stores the flights of an unfinished table in its folder, so that the same command resumes after being killed."""

import hashlib
import shutil
import zipfile
from collections.abc import Hashable, Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np

from ..config.loading import dump
from ..io.files import write_whole
from ..runkit.flights import Flight, FlightSpec
from ..runkit.provenance import section_key
from ..runkit.run import PARTS, Run
from .fleet import Fleet
from .packed_flights import packed, unpacked
from .section_store import file_digests, named_by, named_in

FLIGHTS = f"{PARTS}/flights"
Group = tuple[Hashable, str]
"""A specification's group key; see :attr:`FlightSpec.group`."""


class FlightStore:
    """The flights of a fleet in a run's folder.

    A group contains the flights that one program can fly. It is written only when it is complete. The batches of other
    groups therefore do not change, and their results stay the same, bit for bit.
    """

    def __init__(self, run: Run, fleet: Fleet) -> None:
        """Read the flights of the same fleet that an earlier run with the same code wrote to the folder."""
        self._run, self._over = run, dict[FlightSpec, Flight]()
        self._groups = dict[Group, list[FlightSpec]]()
        for spec in dict.fromkeys(fleet.specs):  # a method that is listed twice flies once
            self._groups.setdefault(spec.group, []).append(spec)
        policies = {str(seed): _digest_of(policy) for seed, policy in fleet.policies.items()}
        about = {"preset": dump(fleet.preset), "policies": policies, "seconds": fleet.seconds}
        self._keys = dict[Group, str]()
        for group, specs in self._groups.items():
            scenarios, method = list(dict.fromkeys(spec.scenario for spec in specs)), specs[0].method
            named = [name for scenario in scenarios for name in named_by(scenario)]
            files = file_digests(method, *named, *named_in(fleet.preset))
            what = {"scenarios": list(map(repr, scenarios)), "method": method, "flights": len(specs), "files": files}
            self._keys[group] = section_key(**about, **what)
        result = [self._read(group) for group in self._groups]
        self.earlier = {flight.spec: flight for flights in result for flight in flights}
        """Flights from an earlier run, which this run does not repeat."""
        run.reused += sum(map(bool, result))

    def save(self, flights: Sequence[Flight]) -> None:
        """Write each group that is complete with these flights."""
        self._over |= {flight.spec: flight for flight in flights}
        for group in dict.fromkeys(flight.spec.group for flight in flights):
            specs = self._groups[group]
            if all(spec in self._over for spec in specs):
                write_whole(self._path(group), packed([self._over.pop(spec) for spec in specs]))

    def _read(self, group: Group) -> list[Flight]:
        """Return the flights of a group; an empty list if the file is missing or cannot be read."""
        try:
            return unpacked(self._path(group).read_bytes(), self._groups[group])
        except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile):
            return []  # the group flies again

    def _path(self, group: Group) -> Path:
        return self._run.folder / FLIGHTS / f"{self._keys[group]}.npz"


def clear_flights(run: Run) -> None:
    """Remove the flights from a run's folder, after their table is written."""
    shutil.rmtree(run.folder / FLIGHTS, ignore_errors=True)


def _digest_of(policy: Any) -> str:
    """Return a digest of a policy's arrays."""
    digest = hashlib.sha256()
    for leaf in jax.tree.leaves(eqx.filter(policy, eqx.is_array)):
        digest.update(np.asarray(leaf).tobytes())
    return digest.hexdigest()[:16]
