"""A process that commands a vehicle when the sender of its commands has ended or is silent.

Some flight stacks hold the last command indefinitely. A guardian belongs in front of such a stack: it has the same
descriptor as the link, but its own session, so that SIGKILL of the link, of all processes of a flight or of their
process group does not end it. It cannot help when its computer stops, or when the cable or the network is cut.

This file is also the program of the process. The program uses the standard library only: it starts within a few
hundredths of a second, and needs little memory.
"""

import contextlib
import json
import os
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

FEED, RELEASE = b".", b"x"
EXIT_S = 1.0  # [s], longest wait for the end of a guardian that is released


@dataclass(frozen=True)
class Phase:
    """Packets that are sent together, again and again."""

    packets: tuple[bytes, ...]
    """Bytes of one datagram or one frame each; empty for a phase of silence."""
    period: float
    """Time from one transmission to the next [s]."""
    duration: float
    """Time until the next phase [s]."""


@dataclass(frozen=True)
class SafeCommands:
    """The packets that a guardian sends, and their times; the bytes are complete, so it does not compute."""

    phases: tuple[Phase, ...]
    """Phases in their order, e.g. "level and sink", then "stop the motors"; after the last one it is silent."""
    timeout: float = 0.25
    """Time without a command after which the first phase begins [s]; it begins at once when the link has ended."""

    def __post_init__(self) -> None:
        """Check the times.

        Raises:
            ConfigError: There is no phase, or a time is not positive.
        """
        times = [self.timeout, *(time for phase in self.phases for time in (phase.period, phase.duration))]
        if not self.phases or not all(0.0 < time < 3600.0 for time in times):
            from ...errors import ConfigError  # local, because this file is also a program, which has no package

            raise ConfigError(f"safe commands: expected phases and times of 0 to 3600 s, not {self}")


class Guardian:
    """The guardian of one link; it waits until the link has sent its first command."""

    def __init__(self, commands: SafeCommands, descriptor: int, to: tuple[str, int] | None = None) -> None:
        """Start the process.

        Args:
            commands: Packets of the guardian.
            descriptor: The link's UDP or TCP socket, or its serial line; the link may close it at any time.
            to: Host and port that receive datagrams; None for a serial line, and for a socket that is connected.

        Raises:
            PlantError: The process cannot be started.
        """
        phases = [[[data.hex() for data in each.packets], each.period, each.duration] for each in commands.phases]
        plan = json.dumps({"phases": phases, "timeout": commands.timeout, "descriptor": descriptor, "to": to})
        try:
            self.process = subprocess.Popen(
                [sys.executable, "-I", "-S", __file__, plan],
                stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
                pass_fds=(descriptor,), start_new_session=True, bufsize=0,
            )  # fmt: skip
        except (OSError, ValueError) as error:
            from ...errors import PlantError  # local for the same reason

            raise PlantError(f"the guardian of the link cannot be started: {error}") from error
        assert self.process.stdin is not None
        self._pipe = self.process.stdin
        os.set_blocking(self._pipe.fileno(), False)  # a guardian that hangs does not stop the link

    def feed(self) -> None:
        """Report a command of the link; call this after each command."""
        self._write(FEED)

    def release(self) -> None:
        """End the guardian without a safe command, because the flight is over; idempotent."""
        self._write(RELEASE)
        self.leave()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(EXIT_S)

    def leave(self) -> None:
        """Let the guardian send its safe commands now, as when the link is killed; idempotent."""
        if not self._pipe.closed:
            with contextlib.suppress(OSError):
                self._pipe.close()
            threading.Thread(target=self.process.wait, daemon=True).start()  # it may need seconds

    def _write(self, data: bytes) -> None:
        if not self._pipe.closed:
            with contextlib.suppress(OSError):  # the guardian has ended, or has not read for a long time
                self._pipe.write(data)


class Feeds:
    """The program's end of the pipe from the link."""

    def __init__(self, pipe: int) -> None:
        """Read from a descriptor."""
        self._pipe, self.is_open = pipe, True

    def came(self, wait: float | None) -> bool:
        """Return whether the link sends a command within a time [s], or None for any time; exit if it releases us."""
        if not self.is_open:
            time.sleep(wait or 0.0)
            return False
        if not select.select([self._pipe], [], [], wait)[0]:
            return False
        data = os.read(self._pipe, 65_536)
        self.is_open = bool(data)
        if RELEASE in data:
            sys.exit(0)
        return self.is_open


def sender_of(descriptor: int, to: list[Any] | None) -> Callable[[bytes, float], None]:
    """Return a function that sends a packet, and gives up after a time [s]."""
    datagrams = None if to is None else socket.socket(fileno=descriptor)

    def send(data: bytes, patience: float) -> None:
        until = time.monotonic() + patience
        with contextlib.suppress(OSError):
            if datagrams is not None and to is not None:
                datagrams.sendto(data, (to[0], to[1]))
                return
            while data and select.select([], [descriptor], [], max(0.0, until - time.monotonic()))[1]:
                data = data[os.write(descriptor, data) :]

    return send


def go_through(phases: list[Any], send: Callable[[bytes, float], None], feeds: Feeds) -> bool:
    """Send the packets of all phases, or return True as soon as the link sends commands again."""
    for packets, period, duration in phases:
        due = time.monotonic()
        end = due + duration
        while time.monotonic() < end:
            for data in packets:
                send(bytes.fromhex(data), period)
            due = max(due + period, time.monotonic())
            if feeds.came(max(0.0, min(due, end) - time.monotonic())):
                return True
    return False


def main() -> None:
    """Wait for the end of the link or for its silence; a link that sends again is guarded again."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # such signals end a flight by a landing, for which the link needs time
    plan = json.loads(sys.argv[1])
    send, feeds = sender_of(plan["descriptor"], plan["to"]), Feeds(sys.stdin.fileno())
    is_fed = feeds.came(None)
    while is_fed:
        while feeds.came(plan["timeout"]):
            pass
        is_fed = go_through(plan["phases"], send, feeds) or feeds.came(None)


if __name__ == "__main__":
    main()
