"""Roles of the processes of a live flight."""

import dataclasses
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from ..adapt.updates import Layer
from ..onboard.plan import ControlPlan
from ..onboard.recorder import RecorderPlan
from ..onboard.topics import VEHICLE
from ..onboard.watchdog import WatchdogPlan
from .operator.page import PagePlan
from .processes.bridge import BridgePlan
from .processes.identifier import IdentifierPlan
from .processes.learner import LearnerPlan
from .processes.plant import PlantPlan
from .spec import LiveSpec


@dataclass(frozen=True)
class RoleRequest:
    """The inputs from which the plan of a process is built."""

    spec: LiveSpec
    start: Path
    """File with the initial state of the learners."""
    bus: Path
    """Folder of the bus."""
    floor: int = 0
    """Policy version; updates up to this version are older than ``start``."""
    cores: frozenset[int] = frozenset()
    """CPU cores of the real-time processes."""
    control: int = 0
    """Process identifier of the control process; 0 before the control process runs."""
    priority: int = 0
    """Real-time priority of the process; 0 for none."""
    parent: int = field(default_factory=os.getpid)
    """Process identifier of the process that starts the others."""


@dataclass(frozen=True)
class Role:
    """A process of a live flight."""

    main: str
    """Main function of the process, as ``module:name``."""
    build: Callable[[RoleRequest], Any]
    """Function that builds the start parameters of the process."""
    is_needed: Callable[[LiveSpec], bool] = lambda spec: True
    """Function that returns whether a flight has this process."""
    priority: int = 0
    """Real-time priority; 0 for a process that runs on other cores than the real-time processes."""
    restarts: bool = True
    """Whether the process sends heartbeats and is restarted when it dies or hangs."""

    def plan(self, request: RoleRequest) -> Any:
        """Return the start parameters of the process, with its real-time priority.

        Args:
            request: The flight, and the processes that already run.
        """
        return self.build(dataclasses.replace(request, priority=self.priority))


def _control(r: RoleRequest) -> ControlPlan:
    s = r.spec
    return ControlPlan(
        r.bus, s.controller, s.limits, s.dt, s.delay_ticks, s.window, s.seconds, r.cores, r.priority, r.parent
    )


def _plant(r: RoleRequest) -> PlantPlan:
    s = r.spec
    return PlantPlan(r.bus, s.scenario, s.vehicle, s.x0, s.dt, s.seed, r.cores, r.priority, r.parent)


def _learner(layer: Layer, r: RoleRequest) -> LearnerPlan:
    s = r.spec
    return LearnerPlan(
        r.bus, layer, r.start, s.reference, s.seed, s.controller.base, r.parent, r.floor, s.trust, s.folder
    )


def _bridge(r: RoleRequest) -> BridgePlan:
    assert r.spec.learners is not None
    return BridgePlan(r.bus, r.spec.learners, r.parent)


def _identifier(r: RoleRequest) -> IdentifierPlan:
    return IdentifierPlan(r.bus, r.start, r.spec.controller.base, r.parent, r.spec.trust)


def _watchdog(r: RoleRequest) -> WatchdogPlan:
    s = r.spec
    return WatchdogPlan(r.bus, s.limits, s.dt, s.home, r.cores, r.priority, r.control, r.parent)


def _recorder(r: RoleRequest) -> RecorderPlan:
    return RecorderPlan(r.bus, r.spec.folder / "flight.csv", r.spec.dt, r.parent, r.spec.spare)


def _page(r: RoleRequest) -> PagePlan:
    assert r.spec.page is not None
    return PagePlan(r.bus, r.spec.page, r.parent)


def _learns_here(layer: Layer, spec: LiveSpec) -> bool:
    return spec.learners is None and layer in spec.layers


ROLES: Mapping[str, Role] = {
    "control": Role("retrim.onboard.control_process:fly", _control, priority=30, restarts=False),
    "plant": Role("retrim.live.processes.plant:simulate", _plant, priority=20, restarts=False),
    "residual": Role(
        "retrim.live.processes.learner:learn", partial(_learner, "residual"), partial(_learns_here, "residual")
    ),
    "policy": Role("retrim.live.processes.learner:learn", partial(_learner, "policy"), partial(_learns_here, "policy")),
    "bridge": Role("retrim.live.processes.bridge:carry", _bridge, lambda spec: spec.learners is not None),
    "identifier": Role(
        "retrim.live.processes.identifier:identify", _identifier, lambda spec: VEHICLE in spec.controller.parameters
    ),
    "watchdog": Role("retrim.onboard.watchdog:watch", _watchdog, priority=40),
    "recorder": Role("retrim.onboard.recorder:record", _recorder),
    "page": Role("retrim.live.operator.page:show", _page, lambda spec: spec.page is not None),
}
"""Processes by role, in the order in which they start."""
