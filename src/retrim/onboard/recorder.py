"""The process that writes the flight down as it goes. What it has written is readable whatever happens to it.

Two processes report ticks: the one that flies, and the watchdog when it takes over. What one of them says late is
written late, and a tick that both of them have flown is written twice; :func:`read_log` puts it in order.
"""

import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import MessageError
from ..transport.bus import Bus
from ..transport.shared_memory import SharedMemoryBus
from .accounts import accounted
from .guard import OVER, Mode
from .heart import Heart
from .messages import ACCOUNTS, COLUMNS, FlightRows, last_note, pack_note
from .realtime import Lifeline

SILENCE = 2.0  # [s] without a tick, after which a flight without a supervisor is over
ENDS = tuple(mode.name.lower() for mode in OVER)
LINGER = 5  # ticks after the end of a flight, in which those who flew may still report their last ones


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
        self._written: set[tuple[int, bool, bool]] = set()
        try:
            self._note(_mended(path))
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
        return self._append(rows[[each not in self._written for each in _authors(rows)]])

    def _append(self, new: np.ndarray) -> int:
        try:
            with self._path.open("a") as file:
                file.write("".join(",".join(f"{value:.9g}" for value in row) + "\n" for row in new))
        except OSError as error:
            self.failed = str(error)
            self._bus.publish("ready.recorder", pack_note("ready", failed=self.failed))
            return 0
        self._note(new)
        return len(new)

    def _note(self, rows: np.ndarray) -> None:
        """Take note of what is written; after any row of a tick nobody needs what the watchdog has only seen of it."""
        for tick, has, flew in _authors(rows):
            self._written |= {(tick, has, flew), (tick, False, False)}


def read_log(path: Path) -> np.ndarray:
    """Return the ticks of a log in their order, in the columns of :data:`retrim.onboard.messages.COLUMNS`.

    A tick that the watchdog flew has its row, with the accounts of the process that was late if there are any. A torn
    last line is left out.

    Raises:
        OSError: There is no such file.
    """
    rows = _lines(path)
    has, flew = accounted(rows), rows[:, -1] == Mode.WATCHDOG
    order = np.lexsort((~has, ~flew, rows[:, 0]))
    ticks, first = np.unique(rows[order, 0], return_index=True)
    found: np.ndarray = rows[order[first]]
    for column in ACCOUNTS.values():
        found[np.searchsorted(ticks, rows[has, 0]), column] = rows[has, column]
    return found


def _lines(path: Path) -> np.ndarray:
    """Return the whole lines of a log as they were written."""
    lines = path.read_text().splitlines(keepends=True)[1:]
    whole = [line.split(",") for line in lines if line.endswith("\n") and line.count(",") == len(COLUMNS) - 1]
    return np.array(whole, dtype=float).reshape(-1, len(COLUMNS))


def _authors(rows: np.ndarray) -> list[tuple[int, bool, bool]]:
    """Return of each row its tick, whether the process that flies reported it, and whether the watchdog flew it."""
    flew = rows[:, -1] == Mode.WATCHDOG
    return list(zip(rows[:, 0].astype(int).tolist(), accounted(rows).tolist(), flew.tolist(), strict=True))


def _mended(path: Path) -> np.ndarray:
    """Write the header, or take away a torn last line; return the rows that are written."""
    if not path.exists() or path.stat().st_size == 0:
        path.write_text(",".join(COLUMNS) + "\n")
        return _lines(path)
    with path.open("r+b") as file:
        data = file.read()
        file.truncate(data.rfind(b"\n") + 1)
    return _lines(path)


def record(plan: RecorderPlan) -> None:
    """Write until the flight is over: the main function of the process."""
    bus = SharedMemoryBus(plan.folder)
    recorder = Recorder(plan.path, bus)
    bus.publish("ready.recorder", pack_note("ready", failed=recorder.failed))
    parent, heard, left, heart = Lifeline(plan.parent), time.monotonic(), LINGER, Heart(bus, "recorder")
    while left and not (parent.gone() and time.monotonic() > heard + SILENCE):
        if recorder.step() or (bus.latest("sample") is None and not parent.gone()):
            heard = time.monotonic()
        left -= _over(bus)
        heart.beat()
        time.sleep(plan.dt)
    recorder.step()
    if parent.gone():
        bus.remove()


def _over(bus: Bus) -> bool:
    return last_note(bus, "status").get("mode") in ENDS or bus.latest("ended") is not None
