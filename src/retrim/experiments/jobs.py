"""A flight as a job for another process: all it needs as a value, and the set-up that the process builds once."""

import functools
from dataclasses import dataclass
from typing import Any

from ..adapt.learner import LearnerState
from ..config.loading import parse
from ..config.setup import Latency, Setup
from ..physics.state import State
from .flights import Flight, FlightSpec
from .flying import fly_one


@dataclass(frozen=True)
class Job:
    """Everything that one flight needs, in a form that can be sent to another process."""

    fleet: str
    """Which fleet it belongs to."""
    preset: str
    policy: Any
    spec: FlightSpec
    x0: State
    seconds: float
    latency: Latency
    state: LearnerState | None


def fly_job(job: Job) -> list[Flight]:
    """Fly a job, in another process: a lot of one flight."""
    setup: Setup = setup_for(job.preset, job.spec.scenario.reference, job.fleet)
    return [fly_one(setup, job.policy, job.spec, job.x0, job.seconds, latency=job.latency, state=job.state)]


@functools.lru_cache(maxsize=16)
def setup_for(preset: str, reference: str | None = None, fleet: str = "") -> Setup:
    """Return a set-up, built once per process and fleet, for executors with other processes.

    Args:
        preset: As JSON.
        reference: What is flown, by name.
        fleet: Tells fleets apart: between two of them a file of a reference may have changed.
    """
    del fleet
    return Setup.of(parse(preset, source="preset"), reference)
