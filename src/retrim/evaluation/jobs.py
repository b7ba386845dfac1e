"""Runs batches of flights as jobs in other processes; a job is a plain value, and each process builds a set-up once."""

import functools
from dataclasses import dataclass, replace
from typing import Any

from ..adapt.learner_state import LearnerState
from ..config.loading import parse
from ..config.setup import Latency, Setup
from ..physics.state import State
from ..runkit.compile_cache import release_programs
from ..runkit.flights import Flight, FlightSpec
from ..runkit.flying import fly_batch, fly_one


@dataclass(frozen=True)
class Job:
    """Everything that a batch of flights needs, in a form that can be sent to another process."""

    fleet: str
    """Identifier of the job's fleet."""
    preset: str
    policies: tuple[Any, ...]
    """Policies or baseline networks, one for each flight."""
    specs: tuple[FlightSpec, ...]
    starts: tuple[State, ...]
    seconds: float
    latency: Latency
    state: LearnerState | None
    keeps_state: bool = True
    """Whether to return each flight's learner state, too; it is as large as the log."""


def fly_job(job: Job) -> list[Flight]:
    """Fly a job in another process: several flights as one program, or a single flight."""
    setup: Setup = setup_for(job.preset, job.specs[0].scenario.reference, job.fleet)
    if len(job.specs) > 1:
        release_programs()
        flights = fly_batch(setup, job.policies, job.specs, job.starts, job.seconds, state=job.state, cold=True)
    else:
        (policy,), (spec,), (x0,) = job.policies, job.specs, job.starts
        flights = [fly_one(setup, policy, spec, x0, job.seconds, latency=job.latency, state=job.state)]
    return flights if job.keeps_state else [replace(flight, learner_state=None) for flight in flights]


@functools.lru_cache(maxsize=16)
def setup_for(preset: str, reference: str | None = None, fleet: str = "") -> Setup:
    """Return a set-up for executors with other processes; it is built once per process and fleet.

    Args:
        preset: The preset, as JSON.
        reference: Name of the reference.
        fleet: Identifier of the fleet; a reference file may have changed since an earlier fleet.
    """
    del fleet
    return Setup.from_preset(parse(preset, source="preset"), reference)
