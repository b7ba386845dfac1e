"""How a live flight stands."""

from dataclasses import dataclass, field
from typing import Any


@dataclass
class Status:
    """A flight as the supervisor sees it."""

    t: float
    """Time since take-off [s]."""
    control: dict[str, Any]
    world: dict[str, Any]
    alive: dict[str, bool]
    restarts: dict[str, int]
    ended: str | None
    """Why the flight is over; None while it is not."""
    rejections: list[str]
    """What learners said since the last look of results that must not be used."""
    watchdog_flies: bool
    """The newest command is the watchdog's."""
    watchdog_ticks: int
    """How often the watchdog has commanded."""
    log_failed: str | None
    """Why the flight is no longer written down; None while it is."""
    stalls: dict[str, Any] = field(default_factory=dict)
    """How often the machine stood still, and for how long."""
    refusals: list[str] = field(default_factory=list)
    """What was refused of notes between processes since the last look."""
    refused_notes: int = 0
    """How many notes and inputs of a browser were refused so far."""
    excluded: list[int] = field(default_factory=list)
    """Numbers of measurements that the last fit excluded, by reason."""
    hangs: dict[str, int] = field(default_factory=dict)
    """How often each process was ended because it was silent."""
    log_moved: str = ""
    """Why the log is another file than it was, and which; empty while it is not."""
    ticks: int = 0
    """Ticks that the plant has sent so far."""
    vehicles: list[tuple[float, str]] = field(default_factory=list)
    """Times of the flight [s], and the vehicle as it was identified then."""
