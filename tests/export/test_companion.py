"""The companion program of the examples flies an exported policy, and exits after a fault.

The flights run in real time, so they are slow.
"""

import os
import re
import shutil
import signal
import socket
import subprocess
import time
from pathlib import Path

import jax
import numpy as np
import pytest
from jax import random

from helpers import tiny_preset
from retrim import Scenario
from retrim.config import changed, load
from retrim.config.setup import Setup
from retrim.export.c_header import write_c
from retrim.export.c_selftest import DAMAGE
from retrim.export.checking import FLAGS
from retrim.export.portable import portable_of
from retrim.onboard.realtime import sleep_until
from retrim.testing.px4 import MotionCapture, Px4Simulation

pytestmark = pytest.mark.skipif(shutil.which("gcc") is None, reason="there is no C compiler")

SOURCE = Path(__file__).parents[2] / "examples" / "companion.c"
PORT = 24590
GOAL, EAST = np.array([0.0, 0.0, 1.0]), 0.0
HOLD, OFFBOARD = (4, 3), (6, 0)
SELF_TEST, WATCHDOG = 2, 3


def build(folder, policy, setup):
    """Compile the program with a policy."""
    write_c(folder / "policy.h", portable_of(policy, setup))
    shutil.copy(SOURCE, folder)
    subprocess.run(["gcc", *FLAGS, "companion.c", "-o", "companion", "-lm"], cwd=folder, check=True)
    return folder / "companion"


@pytest.fixture(scope="module")
def untrained(tmp_path_factory):
    setup = Setup.from_preset(tiny_preset())
    return build(tmp_path_factory.mktemp("untrained"), setup.new_policy(random.key(0)), setup)


def test_program_is_short_and_tests_itself_before_binding():
    text = SOURCE.read_text()
    assert len(text.splitlines()) <= 150
    assert "malloc" not in text
    assert text.index("retrim_selftest()") < text.index("bind(")


def test_damaged_policy_is_refused_at_start(untrained, tmp_path):
    text = (untrained.parent / "policy.h").read_text()
    damaged = re.sub(r"(policy_b0\[\d+\] = {\n)[^,]+,", r"\g<1>0.5f,", text)
    assert damaged != text
    (tmp_path / "policy.h").write_text(damaged)
    shutil.copy(SOURCE, tmp_path)
    subprocess.run(["gcc", *FLAGS, "companion.c", "-o", "companion", "-lm"], cwd=tmp_path, check=True)
    words = [tmp_path / "companion", str(PORT), "0.5"]
    process = subprocess.run(words, capture_output=True, text=True, timeout=20.0, check=False)
    assert process.returncode == SELF_TEST
    assert process.stderr == f"self-test: case {DAMAGE} fails, see policy.h\n"


@pytest.mark.parametrize("words", [(), ("14540",), ("14540", "0"), ("14540", "nan"), ("14540", "1.5"), ("1", "2", "3")])
def test_wrong_arguments_give_one_line(words, untrained):
    process = subprocess.run([untrained, *words], capture_output=True, text=True, timeout=20.0, check=False)
    assert process.returncode == 1
    assert process.stderr == "usage: companion PORT HOVER, e.g. 14540 0.49\n"


def test_occupied_port_is_named(untrained):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        port = str(other.getsockname()[1])
        process = subprocess.run([untrained, port, "0.5"], capture_output=True, text=True, timeout=20.0, check=False)
    assert process.returncode == 1
    assert process.stderr.startswith(f"{port}: ")


def test_messages_equal_pymavlink(untrained):
    """Damaged frames, other senders and other frames of reference are ignored; several messages fit in a datagram."""
    mavlink = pytest.importorskip("pymavlink.dialects.v20.common")
    out = mavlink.MAVLink(None, srcSystem=7, srcComponent=1)
    stranger = mavlink.MAVLink(None, srcSystem=8, srcComponent=1)
    nan = [float("nan")] * 21
    turned = [0.5**0.5, 0.0, 0.0, 0.5**0.5]  # nose to the east

    def odometry(sender, north, frame=1):
        message = sender.odometry_encode(1, frame, 1, north, 2.0, -3.0, turned, 0.1, 0.2, -0.3, 0, 0, 0, nan, nan)
        return message.pack(sender)

    alive = out.heartbeat_encode(2, 12, 0, 4 << 16, 4).pack(out)
    broken = bytearray(odometry(out, 9.0))
    broken[20] ^= 1
    ignored = bytes(broken) + odometry(stranger, 8.0) + odometry(out, 7.0, frame=12)
    received = []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as autopilot:
        autopilot.bind(("127.0.0.1", 0))
        autopilot.settimeout(0.005)
        process = subprocess.Popen([untrained, str(PORT + 1), "0.5"], stdout=subprocess.PIPE, text=True)
        try:
            for _ in range(200):
                autopilot.sendto(b"junk" + alive + odometry(out, 1.0) + ignored, ("127.0.0.1", PORT + 1))
                try:
                    received.append(autopilot.recv(2048))
                except TimeoutError:
                    continue
        finally:
            process.terminate()
        lines = process.communicate()[0].splitlines()
    assert {line.partition(" m,")[0] for line in lines} == {"pilot: 2.00 1.00 3.00"}
    parser = mavlink.MAVLink(None)
    messages = [message for data in received for message in parser.parse_buffer(data) or []]
    kinds = {message.get_type(): message for message in messages}
    assert kinds.keys() == {"HEARTBEAT", "COMMAND_LONG", "SET_ATTITUDE_TARGET"}
    assert (kinds["COMMAND_LONG"].command, kinds["COMMAND_LONG"].param1, kinds["COMMAND_LONG"].param2) == (
        511,
        331,
        1e4,
    )
    target = kinds["SET_ATTITUDE_TARGET"]
    assert (target.target_system, target.target_component, target.type_mask) == (7, 1, 128)
    assert 0.0 <= target.thrust <= 1.0


class Flight:
    """A pilot, the autopilot of a peer, and the program."""

    def __init__(self, peer, process):
        self.peer, self.process = peer, process

    def run(self, seconds):
        """Continue the flight; return the largest distance from the goal."""
        began, worst = time.monotonic(), 0.0
        for tick in range(1, round(100 * seconds) + 1):
            self.peer.step()
            worst = max(worst, float(np.linalg.norm(self.peer.vehicle.p - GOAL)))
            sleep_until(began + 0.01 * tick)
        return worst

    def hand_over(self):
        """Take off to the goal with the autopilot, and select offboard mode."""
        self.peer._place, self.peer._yaw = GOAL, EAST
        self.peer.armed = True
        self.run(7.0)
        assert self.peer.vehicle.flies
        self.peer.mode = OFFBOARD
        self.run(0.5)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    setup = Setup.from_preset(load("hover/retrim"))
    with jax.numpy_dtype_promotion("standard"):  # optax multiplies Python floats by integer counters
        policy = setup.pretrained()
    return build(tmp_path_factory.mktemp("trained"), policy, setup)


@pytest.fixture
def flight(trained):
    pytest.importorskip("pymavlink")
    from retrim.testing.mavlink_peer import MavlinkPeer

    peer = MavlinkPeer(Scenario(plant="simple"), port=PORT)
    share = 9.81 / peer.vehicle.thrust_max
    process = subprocess.Popen(
        [trained, str(PORT), f"{share:.6f}"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    yield Flight(peer, process)
    process.kill()
    process.communicate()
    peer.close()


@pytest.mark.slow
def test_program_hovers_before_and_after_pilot_takes_over(flight):
    flight.hand_over()
    assert flight.peer.by_rates
    assert flight.run(6.0) < 0.15
    flight.peer.mode = HOLD
    flight.run(1.0)
    assert flight.process.poll() is None
    flight.peer.mode = OFFBOARD
    assert flight.run(3.0) < 0.15
    assert flight.peer.failsafes == 0
    flight.process.terminate()
    lines = flight.process.communicate()[0].splitlines()
    assert [line.partition(":")[0] for line in lines].count("policy") >= 5


@pytest.mark.slow
@pytest.mark.parametrize("cause", ["no state", "a pause of the program"])
def test_watchdog_ends_flight(cause, flight):
    """PX4 leaves offboard mode, and the program does not continue."""
    flight.hand_over()
    if cause == "no state":
        flight.peer.cut = True
        flight.run(0.4)
    else:
        flight.process.send_signal(signal.SIGSTOP)
        flight.run(0.3)
        flight.process.send_signal(signal.SIGCONT)
        flight.run(0.3)
    assert flight.process.wait(1.0) == WATCHDOG
    flight.peer.cut = False
    flight.run(2.0)
    assert (flight.peer.mode, flight.peer.failsafes) == (HOLD, 1)
    assert flight.peer.vehicle.flies
    assert re.fullmatch(r"watchdog: state \d+ ms old, tick -?\d+ ms late\n", flight.process.communicate()[1])


PX4 = os.environ.get("RETRIM_PX4", "")
SIH = Path(__file__).parents[2] / "examples" / "px4_sih.toml"


class Px4Pilot:
    """A pilot of PX4's simulation with position setpoints and a motion capture system."""

    def __init__(self):
        self.cameras = MotionCapture()
        self.link = self.cameras.link

    def run(self, seconds, *, place=None):
        """Continue the flight; return the true positions every 0.1 s."""
        positions = []
        for _ in range(round(10 * seconds)):
            if place is not None:
                self.link.fly_to(place, EAST)
            self.cameras.step(time.monotonic() + 0.1)
            positions.append(self.link.truth.p if self.link.truth else np.full(3, np.inf))
        return np.array(positions)


@pytest.mark.skipif(not PX4, reason="RETRIM_PX4 names no unpacked PX4")
@pytest.mark.px4
def test_program_hovers_through_px4_and_px4_falls_back_after_pause(tmp_path):
    setup = Setup.from_preset(changed(load("hover/retrim"), vehicle=str(SIH)))
    with jax.numpy_dtype_promotion("standard"):
        program = build(tmp_path, setup.pretrained(), setup)
    with Px4Simulation(Path(PX4), tmp_path):
        pilot = Px4Pilot()
        try:
            pilot.run(12.0, place=GOAL)
            pilot.link.command(176, 1.0, *map(float, OFFBOARD))
            pilot.link.command(400, 1.0)
            pilot.run(12.0, place=GOAL)
            assert (pilot.link.armed, pilot.link.mode) == (True, OFFBOARD)
            words = [program, "14540", "0.49"]
            process = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
            try:
                pilot.run(0.5, place=GOAL)
                errors = np.linalg.norm(pilot.run(15.0)[30:] - GOAL, axis=1)
                print(f"error [m] from 3 to 15 s: mean {errors.mean():.3f}, largest {errors.max():.3f}")
                assert pilot.link.mode == OFFBOARD
                assert errors.mean() < 0.15
                assert process.poll() is None
                process.send_signal(signal.SIGSTOP)
                pilot.run(0.3)
                process.send_signal(signal.SIGCONT)
                pilot.run(3.0)
                assert process.poll() == WATCHDOG
                assert pilot.link.mode != OFFBOARD
            finally:
                process.kill()
                process.communicate()
        finally:
            pilot.link.close()
