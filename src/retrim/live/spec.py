"""Specification of a live flight."""

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

VEHICLE = "retrim.live.processes.vehicle:fly"
"""Main function of the plant process if the plant is a vehicle."""


@dataclass(frozen=True)
class PageSpec:
    """Specification of a flight's page."""

    host: str
    port: int
    name: str
    """Name of the preset."""
    path: np.ndarray
    """Positions along the reference in the world frame [m], (n, 3)."""
    methods: tuple[str, ...]
    """Available learning methods, the current one first; empty if the flight does not learn."""
    arm: float
    """Distance from the centre of the vehicle to a rotor [m]."""
    mass: float
    """Mass of the vehicle [kg]."""
    paths: Mapping[str, np.ndarray] = field(default_factory=dict)
    """Positions along each available reference in the world frame [m], (n, 3), by name, the current one first; empty if
    there is no choice."""
    world: str = ""
    """Description of the plant and the disturbance."""
    token: str = field(default_factory=lambda: secrets.token_urlsafe(24), repr=False)
    """Secret first part of every path of the page; only the printed address contains this token."""


@dataclass(frozen=True)
class LiveSpec:
    """Specification of all processes of one flight."""

    controller: ControllerSource
    layers: tuple[Layer, ...]
    """Learning layers: ``residual`` and ``policy``; empty if the flight does not learn."""
    start: Path
    """File with the learned state from before the flight."""
    reference: str | None
    scenario: Scenario
    vehicle: Any
    """Vehicle used in training: a name or a specification."""
    x0: np.ndarray
    home: np.ndarray
    limits: Limits
    dt: float
    delay_ticks: int
    window: int
    seconds: float
    """Flight time after which the vehicle lands [s]."""
    seed: int
    folder: Path
    """Folder for the log and for the processes' standard output and error."""
    spare: tuple[Path, ...] = ()
    """Folders for files that cannot be written to ``folder``."""
    page: PageSpec | None = None
    learners: Address | None = None
    """Address of learners on another machine; None for learners on this machine."""
    trust: tuple[str, ...] = ()
    """Python names that ``start`` may contain. The user passed them to this process."""
    mains: Mapping[str, str] = field(default_factory=dict)
    """Main functions that replace those of :data:`retrim.live.roles.ROLES`, by role."""
