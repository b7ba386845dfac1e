"""Status of a live flight."""

from dataclasses import dataclass, field
from typing import Any


@dataclass
class Status:
    """Status of a flight, as the supervisor reports it."""

    t: float
    """Time since take-off [s]."""
    control: dict[str, Any]
    world: dict[str, Any]
    alive: dict[str, bool]
    restarts: dict[str, int]
    ended: str | None
    """Reason for the end of the flight; None before the end."""
    rejections: list[str]
    """Reasons of learners for rejecting their own results since the last status."""
    watchdog_flies: bool
    """Whether the newest command comes from the watchdog."""
    watchdog_ticks: int
    """Number of commands of the watchdog."""
    log_failed: str | None
    """Reason why the flight is no longer logged; None while it is logged."""
    stalls: dict[str, Any] = field(default_factory=dict)
    """Number and duration of stalls of the machine."""
    refusals: list[str] = field(default_factory=list)
    """Refusals of notes between processes since the last status."""
    refused_notes: int = 0
    """Number of refused notes and browser inputs so far."""
    excluded: list[int] = field(default_factory=list)
    """Number of measurements that the last fit excluded, for each reason."""
    hangs: dict[str, int] = field(default_factory=dict)
    """Number of times that each process was ended because it was silent."""
    log_moved: str = ""
    """Message with the reason for a change of the log file and its new path; empty without a change."""
    ticks: int = 0
    """Number of ticks that the plant has sent so far."""
    vehicles: list[tuple[float, str]] = field(default_factory=list)
    """Times of the flight [s] and descriptions of the vehicle identified at these times."""
