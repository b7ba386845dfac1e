"""Plans of the processes of a live flight."""

import os
from pathlib import Path
from typing import Any

from ..adapt.updates import Layer
from ..onboard.plan import ControlPlan
from ..onboard.recorder import RecorderPlan
from ..onboard.watchdog import WatchdogPlan
from .bridge_process import BridgePlan
from .identifier_process import IdentifierPlan
from .learner_process import LearnerPlan
from .page import PagePlan
from .plant_process import PlantPlan
from .spec import LiveSpec

PRIORITIES = {"control": 30, "watchdog": 40, "plant": 20}


def plan_of(role: str, spec: LiveSpec, start: Path, floor: int, bus: Path, cores: frozenset[int], control: int) -> Any:
    """Return the plan of the process with a role.

    Args:
        role: Name of the role.
        spec: Specification of the flight.
        start: File with the initial state of the learners.
        floor: Policy version; updates up to this version are older than ``start``.
        bus: Folder of the bus.
        cores: CPU cores of the real-time processes.
        control: Process identifier of the control process; 0 before the control process runs.
    """
    s, parent = spec, os.getpid()
    if role == "control":
        return ControlPlan(
            bus, s.controller, s.limits, s.dt, s.delay_ticks, s.window, s.seconds, cores, PRIORITIES[role], parent
        )
    if role == "plant":
        return PlantPlan(bus, s.scenario, s.vehicle, s.x0, s.dt, s.seed, cores, PRIORITIES[role], parent)
    if role == "watchdog":
        return WatchdogPlan(bus, s.limits, s.dt, s.home, cores, PRIORITIES[role], control, parent)
    if role == "recorder":
        return RecorderPlan(bus, s.folder / "flight.csv", s.dt, parent, s.spare)
    if role == "page":
        assert s.page is not None
        return PagePlan(bus, s.page, parent)
    if role == "identifier":
        return IdentifierPlan(bus, start, s.controller.base, parent, s.trust)
    if role == "bridge":
        assert s.learners is not None
        return BridgePlan(bus, s.learners, parent)
    layer: Layer = "residual" if role == "residual" else "policy"
    return LearnerPlan(bus, layer, start, s.reference, s.seed, s.controller.base, parent, floor, s.trust, s.folder)
