"""What the process that flies is started with."""

from dataclasses import dataclass
from pathlib import Path

from .guard import Limits
from .pilot import ControllerSource


@dataclass(frozen=True)
class ControlPlan:
    """Everything that the process is started with."""

    folder: Path
    """Of the bus."""
    controller: ControllerSource
    limits: Limits
    dt: float
    delay_ticks: int
    """Declared command delay of the plant."""
    window: int
    """Ticks that are published for those who learn and for the log."""
    seconds: float
    """After which it lands by itself [s]."""
    cores: frozenset[int]
    priority: int
    parent: int
    """Process whose end lands the vehicle."""
