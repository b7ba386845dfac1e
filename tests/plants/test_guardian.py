"""A guardian commands the vehicle of a link that was killed, and does not interfere with other links."""

import contextlib
import os
import select
import signal
import socket
import struct
import subprocess
import sys
import time
import tty
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from retrim import ConfigError
from retrim.plants.bridges import guardian
from retrim.plants.bridges.guardian import Guardian, Phase, SafeCommands

FRAME = struct.Struct("<2d")  # thrust per mass [m/s^2], tilt [rad]
AWAY, SINK, STOP = (FRAME.pack(*each) for each in ((10.0, 0.2), (9.3, 0.0), (0.0, 0.0)))
SINKS_S, STOPS_S, PERIOD = 1.0, 0.2, 0.02
COMMANDS = SafeCommands((Phase((SINK,), PERIOD, SINKS_S), Phase((STOP,), PERIOD, STOPS_S)))
G = 9.81
LATE_S = 0.5  # [s] by which a process without real-time priority may be late while other tests use all cores

# Its program is loaded by its path, because a package that imports JAX would take seconds in each of these processes.
LINK = """
import importlib.util, os, sys, time
spec = importlib.util.spec_from_file_location("guardian", sys.argv[1])
guardian = sys.modules["guardian"] = importlib.util.module_from_spec(spec)
spec.loader.exec_module(guardian)
descriptor, to, away, ends = int(sys.argv[2]), eval(sys.argv[3]), bytes.fromhex(sys.argv[4]), sys.argv[6]
phases = tuple(guardian.Phase((bytes.fromhex(data),), *times) for data, *times in eval(sys.argv[5]))
guard = guardian.Guardian(guardian.SafeCommands(phases), descriptor, to)
send = guardian.sender_of(os.dup(descriptor), to)
until = time.monotonic() + (0.3 if ends else 60.0)
while time.monotonic() < until:
    if ends != "before it commands":
        send(away, 0.1)
        guard.feed()
    time.sleep(0.02)
if ends == "released":
    guard.release()
"""


class Stack:
    """A flight stack that holds its last command indefinitely, and a link to it in a separate process."""

    def __init__(self, kind, ends=""):
        self.kind, self.frames = kind, []
        """Arrival [s], thrust per mass and tilt of each command."""
        to = None
        if kind == "udp":
            self._mine, theirs = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
            self._mine.bind(("127.0.0.1", 0))
            to = self._mine.getsockname()
        elif kind == "tcp":
            with socket.create_server(("127.0.0.1", 0)) as server:
                theirs = socket.create_connection(server.getsockname())
                self._mine = server.accept()[0]
        else:
            mine, line = os.openpty()
            tty.setraw(line)
            self._mine, theirs = (os.fdopen(each, "r+b", buffering=0) for each in (mine, line))
        phases = [(each.packets[0].hex(), each.period, each.duration) for each in COMMANDS.phases]
        words = [guardian.__file__, theirs.fileno(), to, AWAY.hex(), phases, ends]
        self.link = subprocess.Popen(
            [sys.executable, "-I", "-S", "-c", LINK, *map(str, words)], pass_fds=[theirs.fileno()],
            start_new_session=True,
        )  # fmt: skip
        theirs.close()

    def listen(self, seconds):
        """Receive commands."""
        until = time.monotonic() + seconds
        while (left := until - time.monotonic()) > 0.0:
            if select.select([self._mine], [], [], left)[0]:
                with contextlib.suppress(OSError):  # a serial line whose last holder has closed it
                    data = os.read(self._mine.fileno(), 4096)
                    now = time.monotonic()
                    self.frames += [(now, *values) for values in FRAME.iter_unpack(data)]
                    if data:
                        continue
                time.sleep(0.01)

    def close(self):
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.link.pid, signal.SIGKILL)
        self.link.wait()
        self._mine.close()

    def commands(self, since, tilt):
        """Return the arrivals of the commands with a tilt, from an instant on."""
        return [at for at, _, each in self.frames if each == tilt and at > since]

    def speed(self, since, until):
        """Return the horizontal speed gained between two instants with the last command held [m/s]."""
        frames = [frame for frame in self.frames if frame[0] <= since][-1:]
        frames += [frame for frame in self.frames if since < frame[0] <= until]
        times = np.array([since, *(frame[0] for frame in frames[1:]), until])
        return float(sum(dt * c * np.sin(tilt) for dt, (_, c, tilt) in zip(np.diff(times), frames, strict=True)))


def kill(stack):
    """Kill the link, and return the times of the start and the end of the recording that follows."""
    stack.listen(0.8)
    assert not stack.commands(0.0, 0.0)  # the guardian is silent while the link commands
    killed = time.monotonic()
    os.killpg(stack.link.pid, signal.SIGKILL)
    stack.listen(LATE_S + SINKS_S + STOPS_S + 1.0)
    return killed, time.monotonic()


def suspend(stack):
    """Suspend the link for a while; return when it was suspended, and when it commands again."""
    stack.listen(0.6)
    stack.link.send_signal(signal.SIGSTOP)
    stopped = time.monotonic()
    stack.listen(COMMANDS.timeout + LATE_S)
    stack.link.send_signal(signal.SIGCONT)
    stack.listen(LATE_S)
    back = time.monotonic()
    stack.listen(0.4)
    return stopped, back


def await_end(stack):
    stack.listen(1.0 + LATE_S)
    return stack.link.wait(5.0)


SCENARIOS = {
    "udp killed": (kill, "udp"), "tcp killed": (kill, "tcp"), "serial killed": (kill, "serial"),
    "silent": (suspend, "udp"), "released": (await_end, "udp", "released"),
    "before it commands": (await_end, "udp", "before it commands"), "exit": (await_end, "udp", "exit"),
}  # fmt: skip


@pytest.fixture(scope="module")
def recordings():
    """Return a stack and the result of each scenario; they run at the same time, because they only wait."""

    def record(function, *how):
        stack = Stack(*how)
        try:
            return stack, function(stack)
        finally:
            stack.close()

    with ThreadPoolExecutor(len(SCENARIOS)) as pool:
        running = {name: pool.submit(record, *scenario) for name, scenario in SCENARIOS.items()}
    return running


@pytest.mark.parametrize("kind", ["udp", "tcp", "serial"])
def test_guardian_levels_vehicle_after_link_is_killed(recordings, kind):
    stack, (killed, end) = recordings[f"{kind} killed"].result()
    assert stack.commands(0.0, 0.2)
    safe = stack.commands(killed, 0.0)
    assert abs(stack.speed(killed, end)) < 10.0 * np.sin(0.2) * LATE_S
    assert len(safe) > 0.5 * (SINKS_S + STOPS_S) / PERIOD
    assert stack.frames[-1][1:] == (0.0, 0.0)  # the last phase is the last command
    assert safe[-1] - safe[0] == pytest.approx(SINKS_S + STOPS_S, abs=LATE_S)


def test_silent_link_is_replaced_until_it_commands_again(recordings):
    stack, (stopped, back) = recordings["silent"].result()
    first = stack.commands(stopped, 0.0)[0]
    held = [at for at in stack.commands(0.0, 0.2) if at < first][-1]
    assert first - held > 0.5 * COMMANDS.timeout
    assert stack.commands(back, 0.2)
    assert not stack.commands(back, 0.0)


@pytest.mark.parametrize(("ends", "safe"), [("released", False), ("before it commands", False), ("exit", True)])
def test_only_active_unreleased_link_is_replaced(recordings, ends, safe):
    stack, status = recordings[ends].result()
    assert status == 0
    assert bool(stack.commands(0.0, 0.0)) == safe


def test_invalid_phases_and_times_are_refused():
    for phases, timeout in (((), 0.25), ((Phase((b"x",), 0.0, 1.0),), 0.25), (COMMANDS.phases, float("nan"))):
        with pytest.raises(ConfigError, match="expected phases and times"):
            SafeCommands(phases, timeout)


def test_ended_guardian_does_not_stop_link():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as line:
        guard = Guardian(COMMANDS, line.fileno(), ("127.0.0.1", 9))
        guard.process.kill()
        guard.process.wait()
        for _ in range(3):
            guard.feed()
        guard.release()
        guard.release()
