"""Text display of a live flight."""

from collections.abc import Sequence
from typing import Any

from .events import LiveEvents
from .status import Status

FIGURES: tuple[tuple[str, str, tuple[str, ...], float], ...] = (
    ("error, last seconds", "mm", ("steady",), 1000.0),
    ("time until the error stays below 50 mm", "s", ("recovery_5cm",), 1.0),
    ("policy updates, rolled back", "", ("policies", "rolled_back"), 1.0),
    ("age of the flight data at an update, median", "s", ("flight_to_swap_s",), 1.0),
    ("age of the flight data of the policy, median", "s", ("policy_age_p50_s",), 1.0),
    ("missed ticks, in stalls of the machine", "", ("missed_ticks", "missed_in_stalls"), 1.0),
    ("stalls of the machine", "", ("stalls",), 1.0),
    ("longest stall", "ms", ("stall_max_ms",), 1.0),
    ("lateness of a step: median, 99 %, maximum", "ms", ("lateness_p50_ms", "lateness_p99_ms", "lateness_max_ms"), 1.0),
    ("duration of a step: median, 99 %, maximum", "ms", ("step_p50_ms", "step_p99_ms", "step_max_ms"), 1.0),
    ("other work in a tick: median, 99 %, maximum", "ms", ("idle_p50_ms", "idle_p99_ms", "idle_max_ms"), 1.0),
    ("age of the state, 99 %", "ms", ("state_age_p99_ms",), 1.0),
    ("late samples, held commands", "", ("samples_late", "commands_held"), 1.0),
    ("simulation behind the clock", "s", ("simulation_lost_s",), 1.0),
    ("restarted processes, refused messages", "", ("restarts", "refused_messages"), 1.0),
    ("ticks of the fallback controller", "", ("fallback_ticks",), 1.0),
)
"""Label, unit, metrics and factor of each line of the table at the end of a flight."""


def live_line(status: Status) -> str:
    """Return the status of a flight as one line."""
    control = status.control
    controller = "watchdog" if status.watchdog_flies else control.get("mode", "not started")
    versions = ", ".join(f"{half} {n}" for half, n in control.get("versions", {}).items())
    return (
        f"{max(0.0, status.t):.0f} s, {controller}, error {control.get('error', 0.0):.3f} m, "
        f"versions: {versions}, missed ticks: {control.get('missed', 0)}"
    )


def live_rows(status: Status, events: LiveEvents) -> list[tuple[str, str]]:
    """Return the status of a flight as rows, each with a label and a value."""
    control = status.control
    rows: list[tuple[str, str]] = []
    rows.append(("in control", "watchdog" if status.watchdog_flies else control.get("mode", "not started")))
    rows.append(("error", f"{control.get('error', 0.0):.4f} m"))
    for half, version in control.get("versions", {}).items():
        rows.append((f"{half} updates", str(version)))
    rows.append(("missed ticks", str(control.get("missed", 0))))
    if refusals := control.get("refused"):
        rows.append(("refused messages", ", ".join(f"{what}: {n}" for what, n in refusals.items())))
    rows.append(("late samples, held commands", f"{status.world.get('late', 0)}, {status.world.get('held', 0)}"))
    if lost_time := status.world.get("lost"):
        rows.append(("simulation lost", f"{lost_time:.2f} s: the machine is busy"))
    rows.append(("processes", ", ".join(role if alive else f"{role} (dead)" for role, alive in status.alive.items())))
    if events.all:
        rows.append(("last event", f"{events.all[-1].t:.1f} s {events.all[-1].kind}: {events.all[-1].note}"))
    return rows


def figures(rows: Sequence[dict[str, Any]]) -> tuple[tuple[str, str, str], ...]:
    """Return the label, the unit and the value of each figure of a flight, for a table.

    Args:
        rows: Rows of ``results.json``, in which a figure has the name of its metric.
    """
    values = {row["metric"]: row["value"] for row in rows}
    known = {name for _, _, names, _ in FIGURES for name in names}
    result = [
        (label, unit, ", ".join(_format(values[name], factor) for name in names))
        for label, unit, names, factor in FIGURES
        if values.keys() >= set(names)
    ]
    rest = [(name.replace("_", " "), "", _format(value, 1.0)) for name, value in values.items() if name not in known]
    return (*result, *rest)


def _format(value: Any, factor: float) -> str:
    if value is None:
        return "-"
    return f"{factor * value:.3g}" if isinstance(value, float) else str(value)
