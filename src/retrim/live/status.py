"""Status of a live flight."""

from dataclasses import dataclass, field
from typing import Any


@dataclass
class Status:
    """Status of a flight that the supervisor reports."""

    t: float
    """Time since take-off [s]."""
    control: dict[str, Any]
    world: dict[str, Any]
    alive: dict[str, bool]
    restarts: dict[str, int]
    end_reason: str | None
    """Reason for the end of the flight; None before the end."""
    rejections: list[str]
    """Reasons why learners have rejected their own results since the last status."""
    watchdog_flies: bool
    """Whether the newest command comes from the watchdog."""
    watchdog_ticks: int
    """Number of commands from the watchdog."""
    log_failed: str | None
    """Reason why the flight is no longer logged; None while the flight is logged."""
    stalls: dict[str, Any] = field(default_factory=dict)
    """Number and duration of the machine's stalls."""
    refusals: list[str] = field(default_factory=list)
    """Descriptions of the notes between processes that were refused since the last status."""
    refused_notes: int = 0
    """Number of refused notes and browser inputs so far."""
    excluded: list[int] = field(default_factory=list)
    """Number of measurements that the last fit excluded for each reason."""
    hangs: dict[str, int] = field(default_factory=dict)
    """Number of times each process was ended because it was silent."""
    log_moved: str = ""
    """Message about a change of the log file, with the reason and the new path; empty if the file has not changed."""
    ticks: int = 0
    """Number of ticks that the plant has sent so far."""
    vehicles: list[tuple[float, str]] = field(default_factory=list)
    """Flight times [s], with the description of the vehicle that was identified at each time."""
