"""From a flight by hand to a hover through Betaflight's firmware by MSP override; `make test-betaflight` runs it.

The board listens at fixed ports on every address: the tests run in a network namespace of their own. The commands are
those of docs/how-to/from-the-box.md.
"""

import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
import tomllib
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from retrim.onboard.guard import Mode
from retrim.onboard.recorder import read_log

pytestmark = [pytest.mark.slow, pytest.mark.betaflight]
RETRIM = [sys.executable, "-m", "retrim.cli"]
VEHICLE = str(Path(__file__).parents[2] / "examples/five_inch.toml")
PLANT = "msp:tcp:127.0.0.1:5761,pose=/mocap/quad"
WAITS = "the pilot, who hovers"
SETTLES_S = 8.0  # [s] of hover before the pilot turns the switch; the plant needs 3 s


def run(*words):
    subprocess.run([*RETRIM, *words], check=True, capture_output=True, timeout=300)


@pytest.fixture(scope="module")
def identified(tmp_path_factory):
    """Vehicle file from a flight by hand, with the delay of the link."""
    folder = tmp_path_factory.mktemp("manual")
    log = folder / "manual.bfl"
    words = ["--vehicle", VEHICLE, "--log", str(log), "--seconds", "25"]
    subprocess.run([sys.executable, "-m", "retrim.testing.betaflight_peer", *words], check=True, timeout=120)
    run("replay", str(log), "--identify", "--vehicle", VEHICLE, "--out", str(folder / "id"))
    text = (folder / "id/vehicle.toml").read_text()
    path = folder / "identified.toml"
    path.write_text(re.sub(r"(?m)^command_delay = .*", "command_delay = 0.02", text))
    return path


@pytest.fixture(scope="module")
def policy(identified, tmp_path_factory):
    folder = tmp_path_factory.mktemp("hover")
    run("pretrain", "hover", "--vehicle", str(identified), "--out", str(folder))
    return folder


class Pilot:
    """The peer's process: its pilot hovers, and turns the switch when a line is written."""

    def __init__(self, *words):
        command = [sys.executable, "-u", "-m", "retrim.testing.betaflight_peer", "--vehicle", VEHICLE, *words]
        pipe = subprocess.PIPE
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


def wait_for_rows(out, count):
    until = time.monotonic() + 60.0
    while not (out / "flight.csv").exists() or len((out / "flight.csv").read_text().splitlines()) < count:
        assert time.monotonic() < until
        time.sleep(0.1)


def test_the_log_of_a_flight_by_hand_identifies_the_rate_loop(identified):
    file = tomllib.loads(identified.read_text())
    assert 0.005 < file["rate_lag"][0] < 0.06
    assert 0.01 < file["motor_tau"] < 0.06
    assert file["mass"] == 0.72


@pytest.mark.parametrize(("disturbance", "allowance"), [("none", 0.02), ("large", 0.02)])
def test_a_hover_adapts_and_ends_on_the_ground(policy, disturbance, allowance, tmp_path):
    with flight(policy, tmp_path, pilot=("--disturbance", disturbance)) as (process, pilot):
        process.wait(120.0)
        text = (tmp_path / "output.txt").read_text()
        assert process.returncode == 0, text
        assert "flight over: landed" in text
        height, _ = pilot.end()
    figures = {row["metric"]: row["value"] for row in json.loads((tmp_path / "results.json").read_text())["rows"]}
    rows = read_log(tmp_path / "flight.csv")
    print(f"{disturbance}: steady {figures['steady']:.4f} m, {figures['policies']} policies")
    assert rows[-1, -1] == Mode.LANDED
    assert figures["policies"] > 0  # the simulated world and the firmware take most of two cores
    assert figures["steady"] <= allowance
    assert height < 0.2


def test_the_pilot_takes_over_by_the_switch(policy, tmp_path):
    with flight(policy, tmp_path, "--adapt", "none") as (process, pilot):
        wait_for_rows(tmp_path, 150)
        pilot.turn_switch()
        process.wait(60.0)
        assert "the pilot has switched MSP OVERRIDE off, and flies" in (tmp_path / "output.txt").read_text()
        time.sleep(3.0)
        height, tilt = pilot.end()
    assert height == pytest.approx(1.0, abs=0.2)
    assert tilt < 10.0


def test_a_dead_computer_s_guardian_lets_the_vehicle_sink_level(policy, tmp_path):
    """SIGKILL of all processes; without the guardian the board would hold the last body rates for ever."""
    with flight(policy, tmp_path, "--adapt", "none") as (process, pilot):
        wait_for_rows(tmp_path, 150)
        children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
        for each in [process.pid, *map(int, children)]:
            os.kill(each, signal.SIGKILL)
        time.sleep(7.0)
        height, tilt = pilot.end()
    rows = read_log(tmp_path / "flight.csv")
    assert rows[-1, 18:21] == pytest.approx([0.0, 0.0, 1.0], abs=0.1)  # it hovered until then
    assert height < 0.1
    assert np.isfinite(tilt)
    assert tilt < 15.0
