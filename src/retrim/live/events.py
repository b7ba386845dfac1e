"""What happens in a live flight, as events: each once, from reports that repeat themselves."""

from ..runtime.events import Event
from .supervisor import Status


class LiveEvents:
    """Turns the reports of the process that flies into events."""

    def __init__(self) -> None:
        self.all: list[Event] = []
        self._seen: dict[str, int] = {}
        self._mode = "policy"
        self._watchdog = False
        self._restarts: dict[str, int] = {}
        self._rolled_back, self._refused = 0, dict[str, int]()

    def take(self, status: Status) -> list[Event]:
        """Return what is new."""
        t, control, restarts = status.t, status.control, status.restarts
        new: list[Event] = []
        if not (status.alive["control"] or self._watchdog or control.get("mode") == "landed"):
            self._watchdog = True
            new.append(Event(t, "guard", "watchdog: the control process is gone, the watchdog flies the fallback"))
        for at, half, version, age in control.get("swaps", []):
            if version > self._seen.get(half, 0):
                self._seen[half] = version
                new.append(Event(at, half, f"version {version}, learnt from flight until {age:.2f} s before"))
        for version in control.get("rolled_back", [0])[1 + self._rolled_back :]:
            self._rolled_back += 1
            new.append(Event(t, "rejected", f"version {version} flew clearly worse; the policy before it flies again"))
        for what, count in control.get("refused", {}).items():
            if count > self._refused.get(what, 0):
                self._refused[what] = count
                new.append(Event(t, "refused", f"message: {what}, {count} so far"))
        for role, count in restarts.items():
            if count > self._restarts.get(role, 0):
                self._restarts[role] = count
                new.append(Event(t, "restarted", f"the {role} process had died"))
        if (mode := control.get("mode", self._mode)) != self._mode:
            self._mode = mode
            new.append(Event(t, "guard", f"{mode}: {control.get('reason', '')}"))
        self.all += new
        return new
