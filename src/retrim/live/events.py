"""Generate the events of a live flight from periodic reports, each event once."""

from collections.abc import Iterable

from ..control.condition import describe_condition
from ..learn.screening import describe_counts
from ..onboard.pulses import SILENCE
from ..runtime.events import Event
from .status import Status

EXCLUDED_EVERY = 5.0  # [s] between two events about excluded measurements; the duration of a window
HANG_TEXT = f"hung: it said nothing for {SILENCE:g} s and was ended"
LOSS_EFFECTS = {
    "control": "the watchdog flies, holds and lands",
    "plant": "measurements have stopped, and the flight is over",
}
"""Consequence for the flight if a process that cannot be restarted ends, by role."""
WATCHDOG = "watchdog: the process that flew is gone or hangs, the watchdog flies the fallback"


class LiveEvents:
    """Converts the status reports of a flight into events."""

    def __init__(self) -> None:
        self.all: list[Event] = []
        self.swaps: list[tuple[float, str, int, float]] = []
        """Swaps: time [s], parameter group, version, and age of the flight data from which it was learned [s]."""
        self._newest: dict[str, int] = {}
        self._mode, self._watchdog, self._log_failed = "policy", False, False
        self._log_location, self._watchdog_ticks = "", 0
        self._restarts: dict[str, int] = {}
        self._hangs: dict[str, int] = {}
        self._withdrawals: set[int] = set()
        self._refusals: dict[str, int] = {}
        self._knob_refusal = ""
        self._next_exclusion = 0.0  # [s]
        self._last_stage = -1.0  # [s], time of the last stage change that became an event
        self._vehicle_notes: set[str] = set()
        self._identifications = 0

    def take(self, status: Status, others: Iterable[Event] = ()) -> list[Event]:
        """Return the new events, including ``others``."""
        t, control = status.t, status.control
        new = list(others)
        for at, half, version, age in control.get("swaps", []):
            if version > self._newest.get(half, 0):
                self._newest[half] = version
                self.swaps.append((at, half, version, age))
                new.append(Event(at, half, f"version {version}, learned from flight until {age:.2f} s before"))
        for version in control.get("given_up", []):
            if version not in self._withdrawals:
                self._withdrawals.add(version)
                new.append(Event(t, "guard", f"policy: version {version} was rolled back, or comes from one that was"))
        changes = [(at, stage, cause) for at, stage, cause in control.get("stages", []) if at > self._last_stage]
        for at, stage, cause in changes:
            self._last_stage = at
            new.append(Event(at, "stage", describe_condition(stage, cause)))
        new += [Event(at, "vehicle", note) for at, note in status.vehicles[self._identifications :]]
        self._identifications = max(self._identifications, len(status.vehicles))
        if (exclusions := describe_counts(status.excluded)) and t >= self._next_exclusion:
            self._next_exclusion = t + EXCLUDED_EVERY
            new.append(Event(t, "excluded", f"measurements that contradict each other, in the window: {exclusions}"))
        new += [Event(t, "rejected", text) for text in status.rejections]
        for what, count in control.get("refused", {}).items():
            if count > self._refusals.get(what, 0):
                self._refusals[what] = count
                new.append(Event(t, "refused", f"message: {what}, {count} so far"))
        new += [Event(t, "refused", text) for text in status.refusals]
        for note in status.world.get("notes", []):
            if note not in self._vehicle_notes:
                self._vehicle_notes.add(note)
                new.append(Event(t, "refused", f"vehicle: {note}; such messages are ignored"))
        new += self._processes(status)
        if (refusal := status.world.get("knobs_refused", "")) and refusal != self._knob_refusal:
            new.append(Event(t, "refused", f"knobs: {refusal}"))
        self._knob_refusal = refusal
        if status.log_failed and not self._log_failed:
            self._log_failed = True
            new.append(Event(t, "guard", f"log: the flight is no longer recorded, {status.log_failed}"))
        if status.log_moved != self._log_location:
            self._log_location = status.log_moved
            new.append(Event(t, "log", status.log_moved))
        if status.watchdog_flies and not self._watchdog:
            new.append(Event(t, "guard", WATCHDOG))
        if not status.watchdog_flies and (ticks := status.watchdog_ticks - self._watchdog_ticks):
            self._watchdog_ticks = status.watchdog_ticks
            new.append(Event(t, "guard", f"watchdog: it flew {ticks} tick{'s' * (ticks > 1)}, control was late"))
        self._watchdog = status.watchdog_flies
        if (mode := control.get("mode", self._mode)) != self._mode:
            self._mode = mode
            new.append(Event(t, "guard", f"{mode}: {control.get('reason', '')}"))
        self.all += new
        return new

    def _processes(self, status: Status) -> list[Event]:
        """Return events about processes that hang or were restarted."""
        new = []
        for role in sorted(status.hangs.keys() | status.restarts.keys()):
            hangs = status.hangs.get(role, 0) > self._hangs.get(role, 0)
            again = status.restarts.get(role, 0) > self._restarts.get(role, 0)
            why = f"the {role} process {HANG_TEXT if hangs else 'had died'}"
            if again:
                new.append(Event(status.t, "restarted", why))
            elif hangs:
                new.append(
                    Event(status.t, "guard", f"{why}; {LOSS_EFFECTS.get(role, 'the flight continues without it')}")
                )
        self._hangs, self._restarts = dict(status.hangs), dict(status.restarts)
        return new
