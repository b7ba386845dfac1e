"""The process that writes the flight down as it goes. What it has written is readable whatever happens to it.

Two processes report ticks: the one that flies, and the watchdog when it takes over. What one of them says late is
written late; :func:`read_log` puts it in order.
"""

import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import MessageError
from ..transport.bus import Bus
from ..transport.shared_memory import SharedMemoryBus
from .messages import COLUMNS, FlightRows, last_note, pack_note
from .realtime import Lifeline

SILENCE = 2.0  # [s] without a tick, after which a flight without a supervisor is over


@dataclass(frozen=True)
class RecorderPlan:
    """Everything that the process is started with."""

    folder: Path
    """Of the bus."""
    path: Path
    """Of the log, a CSV file with a line per tick."""
    dt: float
    parent: int
    """Who takes the bus away; if it is gone, the recorder does."""


class Recorder:
    """Appends the ticks that are new. A gap is filled from the last seconds of flight, which every report holds."""

    def __init__(self, path: Path, bus: Bus) -> None:
        self._path, self._bus = path, bus
        self._versions = {"flight": 0, "fallback.flight": 0}
        self.failed: str | None = None
        self._written: set[int] = set()
        try:
            self._written = _mended(path)
        except OSError as error:
            self.failed = str(error)

    def step(self) -> int:
        """Write what is new; return how many ticks that were. A full disk ends the log and not the flight."""
        return self._take("flight") + self._take("fallback.flight")

    def _take(self, topic: str) -> int:
        message = self._bus.latest(topic, self._versions[topic])
        if message is None or self.failed:
            return 0
        self._versions[topic] = message.version
        try:
            rows = FlightRows.unpack(message.data).rows
        except MessageError:
            return 0
        return self._append(rows[[int(tick) not in self._written for tick in rows[:, 0]]])

    def _append(self, new: np.ndarray) -> int:
        try:
            with self._path.open("a") as file:
                file.write("".join(",".join(f"{value:.9g}" for value in row) + "\n" for row in new))
        except OSError as error:
            self.failed = str(error)
            self._bus.publish("ready.recorder", pack_note("ready", failed=self.failed))
            return 0
        self._written.update(int(tick) for tick in new[:, 0])
        return len(new)


def read_log(path: Path) -> np.ndarray:
    """Return the ticks of a log in their order, in the columns of :data:`retrim.onboard.messages.COLUMNS`.

    A torn last line is left out.

    Raises:
        OSError: There is no such file.
    """
    lines = path.read_text().splitlines(keepends=True)[1:]
    whole = [line.split(",") for line in lines if line.endswith("\n") and line.count(",") == len(COLUMNS) - 1]
    rows = np.array(whole, dtype=float).reshape(-1, len(COLUMNS))
    return rows[np.argsort(rows[:, 0], kind="stable")]


def _mended(path: Path) -> set[int]:
    """Write the header, or take away a torn last line; return the ticks that are written."""
    if not path.exists() or path.stat().st_size == 0:
        path.write_text(",".join(COLUMNS) + "\n")
        return set()
    with path.open("r+b") as file:
        data = file.read()
        file.truncate(data.rfind(b"\n") + 1)
    return {int(tick) for tick in read_log(path)[:, 0]}


def record(plan: RecorderPlan) -> None:
    """Write until the flight is over: the main function of the process."""
    bus = SharedMemoryBus(plan.folder)
    recorder = Recorder(plan.path, bus)
    bus.publish("ready.recorder", pack_note("ready", failed=recorder.failed))
    parent, heard = Lifeline(plan.parent), time.monotonic()
    while not (_landed(bus) or bus.latest("ended") or (parent.gone() and time.monotonic() > heard + SILENCE)):
        if recorder.step() or (bus.latest("sample") is None and not parent.gone()):
            heard = time.monotonic()
        time.sleep(plan.dt)
    recorder.step()
    if parent.gone():
        bus.remove()


def _landed(bus: Bus) -> bool:
    return last_note(bus, "status").get("mode") == "landed"
