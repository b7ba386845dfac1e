"""The process that writes the flight down as it goes. What it has written is readable whatever happens to it."""

import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import MessageError
from ..transport.bus import Bus
from ..transport.shared_memory import SharedMemoryBus
from .guard import Mode
from .messages import COLUMNS, FlightRows, Sample, Setpoint, pack_note, unpack_note
from .realtime import Lifeline

SOME = 5  # ticks
SILENCE = 1.0  # [s] without a sample, after which a flight without its pilot is over


@dataclass(frozen=True)
class RecorderPlan:
    """Everything that the process is started with."""

    folder: Path
    """Of the bus."""
    path: Path
    """Of the log, a CSV file with a line per tick."""
    dt: float
    control: int
    """The process that flies; the log ends with the flight."""
    parent: int
    """Who takes the bus away; if it is gone, the recorder does."""


class Recorder:
    """Appends the ticks that are new. A gap is filled from the last seconds of flight, which every report holds."""

    def __init__(self, path: Path, bus: Bus, dt: float) -> None:
        self._path, self._bus, self._version, self._dt = path, bus, 0, dt
        self._start: float | None = None
        self._following = False
        self.failed: str | None = None
        self._last = -1
        try:
            self._last = _mended(path)
        except OSError as error:
            self.failed = str(error)

    def step(self) -> int:
        """Write what is new; return how many ticks that were. A full disk ends the log and not the flight."""
        message = self._bus.latest("flight", self._version)
        if message is None or self.failed:
            return 0
        self._version = message.version
        try:
            rows = FlightRows.unpack(message.data).rows
        except MessageError:
            return 0
        new = self._append(rows[rows[:, 0] > self._last])
        self._following = self._following and not new
        return new

    def follow(self) -> int:
        """Write what the plant says and the watchdog commands, where nobody reports any more; return how many ticks."""
        sample, command = self._bus.latest("sample"), self._bus.latest("fallback")
        if sample is None or self.failed:
            return 0
        try:
            said = Sample.unpack(sample.data)
            answer = None if command is None else Setpoint.unpack(command.data)
        except MessageError:
            return 0
        u = answer.u if answer is not None and answer.tick == said.tick else said.accepted
        self._start = said.t - said.tick * self._dt if self._start is None else self._start
        head, tail = [said.tick, said.t - self._start, said.age], [0.0, 0.0, 0.0, said.age, 0.0, Mode.WATCHDOG]
        row = np.concatenate([head, said.state, said.truth, u, tail])
        if said.tick <= self._last:
            return 0
        self._following = True
        return self._append(row[None])

    def behind(self) -> bool:
        """Return whether the plant is some ticks ahead of the reports: the process that flies hangs."""
        sample = self._bus.latest("sample")
        try:
            ahead = 0 if sample is None else Sample.unpack(sample.data).tick - self._last
        except MessageError:
            return False
        return self._following or ahead > SOME

    def _append(self, new: np.ndarray) -> int:
        try:
            with self._path.open("a") as file:
                file.write("".join(",".join(f"{value:.9g}" for value in row) + "\n" for row in new))
        except OSError as error:
            self.failed = str(error)
            self._bus.publish("ready.recorder", pack_note("ready", failed=self.failed))
            return 0
        if len(new):
            self._last = int(new[-1, 0])
        return len(new)


def read_log(path: Path) -> np.ndarray:
    """Return the ticks of a log, in the columns of :data:`retrim.onboard.messages.COLUMNS`; a torn last line is left.

    Raises:
        OSError: There is no such file.
    """
    lines = path.read_text().splitlines(keepends=True)[1:]
    whole = [line.split(",") for line in lines if line.endswith("\n") and line.count(",") == len(COLUMNS) - 1]
    return np.array(whole, dtype=float).reshape(-1, len(COLUMNS))


def _mended(path: Path) -> int:
    """Write the header, or take away a torn last line; return the last tick that is written."""
    if not path.exists() or path.stat().st_size == 0:
        path.write_text(",".join(COLUMNS) + "\n")
        return -1
    with path.open("r+b") as file:
        data = file.read()
        file.truncate(data.rfind(b"\n") + 1)
    rows = read_log(path)
    return int(rows[-1, 0]) if len(rows) else -1


def record(plan: RecorderPlan) -> None:
    """Write until the flight is over: the main function of the process."""
    bus = SharedMemoryBus(plan.folder)
    recorder, control = Recorder(plan.path, bus, plan.dt), Lifeline(plan.control)
    bus.publish("ready.recorder", pack_note("ready", failed=recorder.failed))
    heard = time.monotonic()
    while not (_landed(bus) or bus.latest("ended")) and time.monotonic() < heard + SILENCE:
        silent = control.gone(plan.dt / 4)
        if recorder.step() or ((silent or recorder.behind()) and recorder.follow()):
            heard = time.monotonic()
        if silent:
            time.sleep(plan.dt / 4)
        elif bus.latest("sample") is None:
            heard = time.monotonic()  # on the ground
    recorder.step()
    if Lifeline(plan.parent).gone():
        bus.remove()


def _landed(bus: Bus) -> bool:
    message = bus.latest("status")
    try:
        return message is not None and unpack_note(message.data, "status").get("mode") == "landed"
    except MessageError:
        return False
