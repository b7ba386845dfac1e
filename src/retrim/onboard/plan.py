"""Start parameters of the control process."""

from dataclasses import dataclass
from pathlib import Path

from .guard import Limits
from .pilot import ControllerSource


@dataclass(frozen=True)
class ControlPlan:
    """Start parameters of the process."""

    folder: Path
    """Folder of the bus."""
    controller: ControllerSource
    limits: Limits
    dt: float
    delay_ticks: int
    """Declared command delay of the plant."""
    window: int
    """Number of ticks that are published for the learners and for the log."""
    seconds: float
    """Flight time after which the vehicle lands by itself [s]."""
    cores: frozenset[int]
    priority: int
    parent: int
    """Id of the process whose end triggers the landing."""
