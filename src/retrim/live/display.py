"""Text display of a live flight."""

from collections.abc import Sequence
from typing import Any

from .events import LiveEvents
from .status import Status

UNITS = {"steady": "m", "recovery_5cm": "s", "flight_to_swap_s": "s", "simulation_lost_s": "s"}


def live_line(status: Status) -> str:
    """Return the status of a flight as one line."""
    control = status.control
    flown_by = "watchdog" if status.watchdog_flies else control.get("mode", "not started")
    versions = ", ".join(f"{half} {n}" for half, n in control.get("versions", {}).items())
    return (
        f"{max(0.0, status.t):.0f} s, {flown_by}, error {control.get('error', 0.0):.3f} m, "
        f"versions: {versions}, missed ticks: {control.get('missed', 0)}"
    )


def live_rows(status: Status, events: LiveEvents) -> list[tuple[str, str]]:
    """Return the status of a flight as rows, each with a label and a value."""
    control = status.control
    rows: list[tuple[str, str]] = []
    rows.append(("flown by", "watchdog" if status.watchdog_flies else control.get("mode", "not started")))
    rows.append(("error", f"{control.get('error', 0.0):.4f} m"))
    for half, version in control.get("versions", {}).items():
        rows.append((f"{half} swaps", str(version)))
    rows.append(("missed ticks", str(control.get("missed", 0))))
    if refused := control.get("refused"):
        rows.append(("refused messages", ", ".join(f"{what}: {n}" for what, n in refused.items())))
    rows.append(("late samples, held commands", f"{status.world.get('late', 0)}, {status.world.get('held', 0)}"))
    if lost := status.world.get("lost"):
        rows.append(("simulation lost", f"{lost:.2f} s: the machine is busy"))
    rows.append(("processes", ", ".join(role if alive else f"{role} (dead)" for role, alive in status.alive.items())))
    if events.all:
        rows.append(("last event", f"{events.all[-1].t:.1f} s {events.all[-1].kind}: {events.all[-1].note}"))
    return rows


def figures(rows: Sequence[dict[str, Any]]) -> tuple[tuple[str, str, str], ...]:
    """Return the metric, unit and value of each row of the results."""
    return tuple((row["metric"], UNITS.get(row["metric"], ""), _shown(row["value"])) for row in rows)


def _shown(value: object) -> str:
    return "-" if value is None else f"{value:.3f}" if isinstance(value, float) else str(value)
