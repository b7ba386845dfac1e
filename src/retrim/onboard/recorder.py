"""The recorder process, which writes the log during the flight. The log stays readable if the process ends early.

Two processes report ticks: the control process, and the watchdog if it takes over. The log may therefore contain ticks
out of order, and a tick that both processes have commanded twice; :func:`read_log` sorts the ticks.
"""

import contextlib
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import MessageError
from ..transport.bus import Bus
from ..transport.shared_memory import SharedMemoryBus
from .guard import FINAL_MODES, Mode
from .heartbeat import Heart
from .log_file import HEADER, LogFile, log_path
from .messages import ACCOUNTS, COLUMNS, FlightRows, last_note, pack_note
from .realtime import ParentWatch
from .timing_stats import is_from_control

SILENCE = 2.0  # [s] without a tick, after which a flight without a supervisor is over
ENDS = tuple(mode.name.lower() for mode in FINAL_MODES)
LINGER = 5  # ticks after the end of a flight, during which control and the watchdog may report their last ticks


@dataclass(frozen=True)
class RecorderPlan:
    """Start parameters of the recorder process."""

    folder: Path
    """Folder of the bus."""
    path: Path
    """Path of the log, a CSV file with one line per tick."""
    dt: float
    parent: int
    """Id of the process that removes the bus; if that process has ended, the recorder removes the bus."""
    spare: tuple[Path, ...] = ()
    """Folders for the log if it cannot be written to ``path``."""


class Recorder:
    """Appends new ticks to the log. Each report contains the last few seconds of flight, so later reports fill gaps."""

    def __init__(self, path: Path, bus: Bus, spare: Sequence[Path] = ()) -> None:
        """Continue a log, or create one.

        Args:
            path: Path of the log.
            bus: Bus of the flight.
            spare: Folders for the log if it cannot be written to ``path``; see :func:`log_path`.
        """
        self._bus, self._paths = bus, (path, *(folder / path.name for folder in spare))
        self._versions = {"flight": 0, "fallback.flight": 0}
        self.failed: str | None = None
        """Reason why the log has ended; None while the log continues."""
        self.notice = ""
        """Message about a change of the file, with the reason and the new file; empty if there was no change."""
        self._row_keys: set[tuple[int, bool, bool]] = set()
        self._file: LogFile | None = None
        try:
            self._file = LogFile(log_path(path, spare))
            self._note(_rows(self._file.tail()))
        except OSError as error:
            self._move(error)

    def step(self) -> int:
        """Write new ticks and return their number. A write error may end the log, but it does not end the flight."""
        return self._take("flight") + self._take("fallback.flight")

    def tell(self) -> None:
        """Publish that the log is ready, and whether it failed or moved."""
        self._bus.publish("ready.recorder", pack_note("ready", failed=self.failed, moved=self.notice))

    def close(self) -> None:
        """Close the log."""
        if self._file is not None:
            self._file.close()

    def _take(self, topic: str) -> int:
        message = self._bus.latest(topic, self._versions[topic])
        if message is None or self.failed:
            return 0
        self._versions[topic] = message.version
        try:
            rows = FlightRows.unpack(message.data).rows
        except MessageError:
            return 0
        return self._append(rows[[each not in self._row_keys for each in _authors(rows)]])

    def _append(self, new: np.ndarray) -> int:
        lines = "".join(",".join(f"{value:.9g}" for value in row) + "\n" for row in new).encode()
        while self._file is not None and not self.failed:
            try:
                self._file.append(lines)
            except OSError as error:
                self._move(error)
            else:
                self._note(new)
                return len(new)
        return 0

    def _move(self, why: OSError) -> None:
        """Copy the log to a different file and continue there; record a failure if no file can be written."""
        reason = f"{self._paths[0]}: {why.strerror or why}"
        for path in self._paths:
            with contextlib.suppress(OSError):
                path.parent.mkdir(parents=True, exist_ok=True, mode=0o777 if path == self._paths[0] else 0o700)
                log_file = LogFile(path, new=True)
                try:
                    log_file.append(HEADER if self._file is None else self._file.all())
                except OSError:
                    path.unlink()
                    raise
                self.close()
                self._file = log_file
                where = "is written again" if path == self._paths[0] else f"continues in {path}"
                self.notice = f"{reason}; the log {where}"
                break
        else:
            self.failed = reason
        self.tell()

    def _note(self, rows: np.ndarray) -> None:
        """Record the written rows; a row from a watchdog that did not command is redundant if the tick has any row."""
        for tick, has, flew in _authors(rows):
            self._row_keys |= {(tick, has, flew), (tick, False, False)}


def read_log(path: Path) -> np.ndarray:
    """Return the ticks of a log in order, with the columns in :data:`retrim.onboard.messages.COLUMNS`.

    For a tick that the watchdog commanded, the result contains the watchdog's row, with the deadline statistics of the
    late control process if it reported any. An incomplete last line is omitted.

    Raises:
        OSError: There is no such file.
    """
    rows = _lines(path)
    has, flew = is_from_control(rows), rows[:, -1] == Mode.WATCHDOG
    order = np.lexsort((~has, ~flew, rows[:, 0]))
    ticks, first = np.unique(rows[order, 0], return_index=True)
    result: np.ndarray = rows[order[first]]
    for column in ACCOUNTS.values():
        result[np.searchsorted(ticks, rows[has, 0]), column] = rows[has, column]
    return result


def _lines(path: Path) -> np.ndarray:
    """Return the whole lines of a log as they were written."""
    return _rows(path.read_bytes())


def _rows(data: bytes) -> np.ndarray:
    lines = data.decode().splitlines(keepends=True)
    whole = [line.split(",") for line in lines if line.endswith("\n") and line.count(",") == len(COLUMNS) - 1]
    return np.array([line for line in whole if line[0] != COLUMNS[0]], dtype=float).reshape(-1, len(COLUMNS))


def _authors(rows: np.ndarray) -> list[tuple[int, bool, bool]]:
    """Return each row's tick, whether the control process reported it, and whether the watchdog commanded it."""
    flew = rows[:, -1] == Mode.WATCHDOG
    return list(zip(rows[:, 0].astype(int).tolist(), is_from_control(rows).tolist(), flew.tolist(), strict=True))


def record(plan: RecorderPlan) -> None:
    """Write the log until the flight is over; this is the main function of the process."""
    bus = SharedMemoryBus(plan.folder)
    recorder = Recorder(plan.path, bus, plan.spare)
    recorder.tell()
    parent, last_message, left, heart = ParentWatch(plan.parent), time.monotonic(), LINGER, Heart(bus, "recorder")
    while left and not (parent.has_ended() and time.monotonic() > last_message + SILENCE):
        if recorder.step() or (bus.latest("sample") is None and not parent.has_ended()):
            last_message = time.monotonic()
        left -= _over(bus)
        heart.beat()
        time.sleep(plan.dt)
    recorder.step()
    recorder.close()
    if parent.has_ended():
        bus.remove()


def _over(bus: Bus) -> bool:
    return last_note(bus, "status").get("mode") in ENDS or bus.latest("ended") is not None
