"""Flights through Betaflight's firmware by MSP override, with the commands of docs/how-to/from-the-box.md.

The board listens at fixed ports on every address: the flights run in a network namespace of their own.
"""

import os
import re
import signal
import subprocess
import sys
import threading
import time
from contextlib import contextmanager
from pathlib import Path

RETRIM = [sys.executable, "-m", "retrim.cli"]
PEER = [sys.executable, "-u", "-m", "retrim.testing.betaflight_peer"]
VEHICLE = str(Path(__file__).parents[1] / "examples/five_inch.toml")
PLANT = "msp:tcp:127.0.0.1:5761,pose=/mocap/quad"
WAITS = "the pilot, who hovers"
SETTLES_S = 8.0  # [s] of hover before the pilot turns the switch; the plant needs 3 s


def run(*words):
    subprocess.run([*RETRIM, *words], check=True, capture_output=True, timeout=300)


def identify(folder, *settings):
    """Fly by hand, and return the file of the identified vehicle, with the delay of the link."""
    log = folder / "manual.bfl"
    subprocess.run(
        [*PEER, "--vehicle", VEHICLE, "--log", str(log), "--seconds", "25", *settings], check=True, timeout=120
    )
    run("replay", str(log), "--identify", "--vehicle", VEHICLE, "--out", str(folder / "id"))
    text = (folder / "id/vehicle.toml").read_text()
    path = folder / "identified.toml"
    path.write_text(re.sub(r"(?m)^command_delay = .*", "command_delay = 0.02", text))
    return path


class Pilot:
    """The peer's process: its pilot hovers, and turns the switch when a line is written."""

    def __init__(self, *words):
        pipe, command = subprocess.PIPE, [*PEER, "--vehicle", VEHICLE, *words]
        self.process = subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True, bufsize=1)
        self.lines = []
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()
        self.wait_for("hovers", 60.0)

    def _read(self):
        for line in self.process.stdout:
            self.lines.append(line)

    def wait_for(self, words, seconds):
        until = time.monotonic() + seconds
        while not any(words in line for line in self.lines):
            assert time.monotonic() < until, self.lines
            assert self.process.poll() is None, self.lines
            time.sleep(0.05)

    def turn_switch(self):
        self.process.stdin.write("\n")
        self.process.stdin.flush()

    def close(self):
        """Close the pipes."""
        self._reader.join(5.0)
        self.process.stdin.close()
        self.process.stdout.close()

    def end(self):
        """Height and tilt at the end [m, deg]."""
        self.process.send_signal(signal.SIGINT)
        self.process.wait(20.0)
        time.sleep(0.1)
        return tuple(map(float, re.search(r"height (\S+) m, tilt (\S+) deg", self.lines[-1]).groups()))


@contextmanager
def flight(policy, out, *words, pilot=(), seconds=20):
    """A pilot, and a live flight that was handed over to retrim."""
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    person = Pilot(*pilot)
    out.mkdir(exist_ok=True)
    command = [*RETRIM, "live", "--policy", str(policy), "--plant", PLANT, "--no-page", "--seconds", str(seconds)]
    with (out / "output.txt").open("w") as output:
        process = subprocess.Popen([*command, "--out", str(out), *words], stdout=output, start_new_session=True)
    try:
        until = time.monotonic() + 120.0
        while WAITS not in (out / "output.txt").read_text():
            assert process.poll() is None, (out / "output.txt").read_text()
            assert time.monotonic() < until
            time.sleep(0.2)
        time.sleep(SETTLES_S)
        person.turn_switch()
        yield process, person
    finally:
        for each in (process, person.process):
            if each.poll() is None:
                each.kill()
                each.wait()
        person.close()
