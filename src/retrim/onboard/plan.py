"""Start parameters of the control process."""

from dataclasses import dataclass
from pathlib import Path

from .guard import Limits
from .pilot import ControllerSource


@dataclass(frozen=True)
class ControlPlan:
    """Start parameters of the control process."""

    folder: Path
    """Folder of the bus."""
    controller: ControllerSource
    limits: Limits
    dt: float
    delay_ticks: int
    """Declared command delay of the plant [ticks]."""
    window: int
    """Number of ticks in each report for the learners and the log."""
    seconds: float
    """Flight time after which the vehicle lands automatically [s]."""
    cores: frozenset[int]
    priority: int
    parent: int
    """Id of the process whose end triggers the landing."""
