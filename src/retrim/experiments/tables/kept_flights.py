"""Flights of a table that is not made yet are kept in its folder: the same command goes on where it was killed."""

import hashlib
import shutil
import zipfile
from collections.abc import Hashable, Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np

from ...config.loading import dump
from ...io.files import write_whole
from ..fleet import Fleet
from ..flights import Flight, FlightSpec
from ..packed_flights import packed, unpacked
from ..provenance import section_key
from ..run import PARTS, Run
from .kept import files_behind, named_by, named_in

FLIGHTS = f"{PARTS}/flights"
Group = tuple[Hashable, str]
"""Of a specification; see :attr:`FlightSpec.group`."""


class KeptFlights:
    """The flights of a fleet in the folder of a run.

    Each group of flights that one program can fly is kept once it is complete, so that the lots of the other groups
    stay the same and fly the same, bit for bit.
    """

    def __init__(self, run: Run, fleet: Fleet) -> None:
        """Find what an earlier run of the folder has flown of the same fleet, by the same code."""
        self._run, self._over = run, dict[FlightSpec, Flight]()
        self._groups = dict[Group, list[FlightSpec]]()
        for spec in dict.fromkeys(fleet.specs):  # who names a method twice has its flights once
            self._groups.setdefault(spec.group, []).append(spec)
        policies = {str(seed): _digest_of(policy) for seed, policy in fleet.policies.items()}
        about = {"preset": dump(fleet.preset), "policies": policies, "seconds": fleet.seconds}
        self._keys = dict[Group, str]()
        for group, specs in self._groups.items():
            scenarios, method = list(dict.fromkeys(spec.scenario for spec in specs)), specs[0].method
            named = [name for scenario in scenarios for name in named_by(scenario)]
            files = files_behind(method, *named, *named_in(fleet.preset))
            what = {"scenarios": list(map(repr, scenarios)), "method": method, "flights": len(specs), "files": files}
            self._keys[group] = section_key(**about, **what)
        found = [self._read(group) for group in self._groups]
        self.earlier = {flight.spec: flight for flights in found for flight in flights}
        """What need not be flown again."""
        run.taken_over += sum(map(bool, found))

    def landed(self, flights: Sequence[Flight]) -> None:
        """Keep each group that is whole with these flights."""
        self._over |= {flight.spec: flight for flight in flights}
        for group in dict.fromkeys(flight.spec.group for flight in flights):
            specs = self._groups[group]
            if all(spec in self._over for spec in specs):
                write_whole(self._path(group), packed([self._over.pop(spec) for spec in specs]))

    def _read(self, group: Group) -> list[Flight]:
        """Return the flights of a group; none if they are not there, or cannot be read."""
        try:
            return unpacked(self._path(group).read_bytes(), self._groups[group])
        except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile):
            return []  # they are flown again

    def _path(self, group: Group) -> Path:
        return self._run.folder / FLIGHTS / f"{self._keys[group]}.npz"


def forget_flights(run: Run) -> None:
    """Remove the flights in the folder of a run, once what they were flown for is written."""
    shutil.rmtree(run.folder / FLIGHTS, ignore_errors=True)


def _digest_of(policy: Any) -> str:
    """Return a digest of the numbers of what flies."""
    digest = hashlib.sha256()
    for leaf in jax.tree.leaves(eqx.filter(policy, eqx.is_array)):
        digest.update(np.asarray(leaf).tobytes())
    return digest.hexdigest()[:16]
