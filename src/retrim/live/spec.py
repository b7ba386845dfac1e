"""A live flight, before it has processes."""

import secrets
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ..adapt.updates import Layer
from ..config.scenario import Scenario
from ..onboard.guard import Limits
from ..onboard.pilot import ControllerSource
from ..transport.remote import Address

MAINS = {
    "control": "retrim.onboard.control_process:fly",
    "watchdog": "retrim.onboard.watchdog:watch",
    "recorder": "retrim.onboard.recorder:record",
    "plant": "retrim.live.plant_process:simulate",
    "residual": "retrim.live.learner_process:learn",
    "policy": "retrim.live.learner_process:learn",
    "identifier": "retrim.live.identifier_process:identify",
    "page": "retrim.live.page:show",
    "bridge": "retrim.live.bridge_process:carry",
}
"""Main function of each process, by role."""
VEHICLE = "retrim.live.vehicle_process:fly"
"""Main function of the plant's process where the plant is a vehicle."""


@dataclass(frozen=True)
class PageSpec:
    """The page of a flight."""

    host: str
    port: int
    name: str
    """Of what flies."""
    path: np.ndarray
    """Places that the reference passes, world [m], (n, 3)."""
    methods: tuple[str, ...]
    """Ways of learning to choose from, the present one first; none if nothing learns."""
    arm: float
    """From the centre of the vehicle to a rotor [m]."""
    mass: float
    """Of the vehicle [kg]."""
    paths: Mapping[str, np.ndarray] = field(default_factory=dict)
    """References to choose from by name, the present one first, and places that each passes, world [m], (n, 3); none
    if nothing is to be chosen."""
    world: str = ""
    """What flies where, in words."""
    token: str = field(default_factory=lambda: secrets.token_urlsafe(24), repr=False)
    """First part of every path of the page, which only its printed address has."""


@dataclass(frozen=True)
class LiveSpec:
    """Everything that the processes of one flight are started with."""

    controller: ControllerSource
    layers: tuple[Layer, ...]
    """Layers of learning: ``residual``, ``policy``, or none."""
    start: Path
    """File with what was learnt before the flight."""
    reference: str | None
    scenario: Scenario
    vehicle: Any
    """Vehicle of training, by name or specification."""
    x0: np.ndarray
    home: np.ndarray
    limits: Limits
    dt: float
    delay_ticks: int
    window: int
    seconds: float
    """After which the vehicle lands [s]."""
    seed: int
    folder: Path
    """Where the log goes, and what the processes write to their standard outputs."""
    spare: tuple[Path, ...] = ()
    """Where files go that cannot be written there."""
    page: PageSpec | None = None
    learners: Address | None = None
    """Where learners on another machine are reached; None: they are processes of this one."""
    trust: tuple[str, ...] = ()
    """Python names that ``start`` may hold: the user named them to this process."""
    mains: Mapping[str, str] = field(default_factory=lambda: MAINS)
    """What runs as each process; another link to a vehicle is another main function of the plant."""
