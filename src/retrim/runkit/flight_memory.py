"""Memory between flights: the map of earlier flights of the same vehicle, in one folder per place.

A file contains only the state of the residual model, which is data. The policy of the next flight is the one that its
command names, since a policy that was adapted to other conditions may be worse than the pretrained one.
"""

import dataclasses
import hashlib
import re
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
from jax import random
from jaxtyping import Array, Key
from pydantic import TypeAdapter

from ..adapt.learner_state import LearnerState
from ..config.methods import find_method
from ..config.scenario import Scenario
from ..config.setup import Setup
from ..config.vehicle_file import VehicleSpec
from ..config.vehicles import name_of
from ..control.policy import AbstractPolicy
from ..errors import CheckpointError, ConfigError, MessageError
from ..io.files import check_writable, read_bounded, write_whole
from ..io.releases import this_release
from ..io.sanity import check_size
from ..transport import wire
from .flights import Flight

KIND = "memory"
LARGEST_NUMBER = 1e12  # largest number in a file
STRONGEST = 50.0  # [m/s^2], largest acceleration of a map
MEMORY_TAG = 2**30 + 7  # folded into the seed of a flight for the parts of the state that are not remembered


@dataclasses.dataclass(frozen=True)
class FlightMemory:
    """The memory of one vehicle at one place."""

    folder: Path
    """Folder of the place."""
    vehicle: str | VehicleSpec
    """The vehicle: its name, or the content of its vehicle file."""

    @property
    def digest(self) -> str:
        """Digest of the vehicle, which distinguishes vehicle files with the same name."""
        return hashlib.sha256(TypeAdapter(str | VehicleSpec).dump_json(self.vehicle)).hexdigest()[:16]

    def path(self, setup: Setup) -> Path:
        """Return the file for a set-up: one for each vehicle, residual model and control period."""
        preset = setup.preset
        name = f"{name_of(self.vehicle)}_{preset.adapt.residual}_{1000 * preset.dt:g}ms"
        return self.folder / f"{re.sub(r'[^A-Za-z0-9._-]+', '-', name).lstrip('.-')}.safetensors"

    def state(self, setup: Setup, policy: AbstractPolicy, method: str, seed: int) -> LearnerState | None:
        """Return the learner state at the start of the next flight; None if there is no earlier flight.

        Args:
            setup: Set-up of the flight.
            policy: Policy of the flight.
            method: Method of the flight, which must learn.
            seed: Seed of the flight.

        Raises:
            ConfigError: The method does not learn, or the residual model has no memory beyond a flight.
            CheckpointError: The file is damaged, or belongs to a different model or vehicle.
        """
        recall = _recall(setup)
        learns = find_method(method).learns
        if learns is None:
            raise ConfigError(f"a memory needs a method that learns, such as full; {method!r} does not")
        if not (path := self.path(setup)).exists():
            return None
        key: Key[Array, ""] = random.fold_in(random.key(seed), MEMORY_TAG)
        like = jax.eval_shape(setup.learner.residual_model.init, key)
        try:
            data = read_bounded(path, "a flight writes it")
            about = wire.describe(data, kind=KIND, source=str(path))
            residual: Any = wire.unpack(data, like, kind=KIND, source=str(path))
        except MessageError as error:
            raise CheckpointError(f"{error}; remove the file to fly without it") from error
        owner, name = about.get("vehicle", ""), name_of(self.vehicle)
        if owner != name:  # two names may differ only in characters that a file name cannot have
            raise CheckpointError(f"{path}: is the memory of vehicle {owner!r}, expected {name!r}")
        if about.get("digest") != self.digest:
            raise CheckpointError(
                f"{path}: must be the memory of this vehicle {name!r}, but was written for other values, or by an "
                "earlier release; choose another --memory, or remove the file"
            )
        check_size(residual, source=str(path), largest=LARGEST_NUMBER)
        residual_state = recall(residual)
        model: Any = setup.learner.residual_model
        if not (strength := float(model.strength(residual_state))) <= STRONGEST:
            raise CheckpointError(
                f"{path}: its map has accelerations of {strength:.3g} m/s^2, at most {STRONGEST:g} can be flown; "
                "remove the file to fly without it"
            )
        fresh = setup.learner.init(learns(setup, policy, key), key)
        return dataclasses.replace(fresh, residual=residual_state)

    def describe(self, setup: Setup) -> str:
        """Return one line about the memory and its age."""
        path = self.path(setup)
        if not path.exists():
            return f"memory: no earlier flight of {name_of(self.vehicle)} in {self.folder}"
        hours = (time.time() - path.stat().st_mtime) / 3600.0
        return f"memory: {path}, written {hours:.1f} h ago"

    def write(self, flights: Sequence[Flight], setup: Setup, faults: list[str]) -> list[Path]:
        """Write the memory after the first flight that learned and was not terminated; return the file, if any.

        Args:
            flights: Flights of one set-up.
            setup: Set-up of the flights.
            faults: Receives one line if the file cannot be written, or if no flight can be remembered.
        """
        state = next((f.learner_state for f in flights if f.learner_state is not None and not f.log.terminated), None)
        if state is None:
            faults.append(f"the memory in {self.folder} is unchanged: no flight that learned ended without a crash")
            return []
        about = {"vehicle": name_of(self.vehicle), "digest": self.digest, "residual": setup.preset.adapt.residual,
                 "version": this_release()}  # fmt: skip
        path = self.path(setup)
        try:
            write_whole(path, wire.pack(state.residual, kind=KIND, about=about))
        except OSError as error:
            faults.append(f"the memory cannot be written to {path} ({error.strerror or error})")
            return []
        return [path]


def write_memory(memory: FlightMemory | None, flights: Sequence[Flight], setup: Setup, faults: list[str]) -> list[Path]:
    """Write a memory after its flights; return the file, if any. See :meth:`FlightMemory.write`."""
    return [] if memory is None else memory.write(flights, setup, faults)


def recall_flight(
    folder: Path | None,
    setup: Setup,
    scenario: Scenario,
    policy: AbstractPolicy,
    state: LearnerState | None,
    method: str,
    seed: int,
    say: Callable[[str], None],
) -> tuple[FlightMemory | None, LearnerState | None]:
    """Return the memory of a place, and the learner state at the start of the flight.

    Args:
        folder: Folder of the place, if the flight has a memory.
        setup: Set-up of the flight.
        scenario: Scenario of the flight, with its vehicle.
        policy: Policy of the flight.
        state: Learner state from which the flight resumes, if any.
        method: Method of the flight.
        seed: Seed of the flight.
        say: Function that receives a line about the memory and its age.

    Raises:
        ConfigError: The flight resumes a learner state or has no memory to keep, or the folder cannot be written.
        CheckpointError: The memory is damaged, or is that of another vehicle with the same name.
    """
    if folder is None:
        return None, state
    if state is not None:
        raise ConfigError("--memory and --resume: choose one, since each has its own residual model")
    if folder.exists() and not folder.is_dir():
        raise ConfigError(f"--memory {folder} must be a folder, but is a file; choose a different --memory")
    memory = FlightMemory(folder, scenario.entry.own_vehicle or scenario.vehicle or setup.preset.vehicle)
    state = memory.state(setup, policy, method, seed)
    check_writable(folder, "--memory")
    say(memory.describe(setup))
    return memory, state


def _recall(setup: Setup) -> Callable[[Any], Any]:
    recall: Callable[[Any], Any] | None = getattr(setup.learner.residual_model, "recall", None)
    if recall is None:
        raise ConfigError(
            f"residual {setup.preset.adapt.residual!r} has a memory of seconds, and nothing to keep for the next "
            "flight; use --residual place"
        )
    return recall
