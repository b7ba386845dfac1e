"""Real-time flights with Betaflight's firmware as the rate controller. `make test-betaflight` installs and runs it.

The board listens at fixed ports on every address, so the tests run in a separate network namespace.
"""

import json
import os
import subprocess
import sys
import time

import numpy as np
import pytest

from retrim import Scenario
from retrim.onboard.guard import Mode
from retrim.onboard.recorder import read_log
from retrim.testing import check_vehicle

pytestmark = [pytest.mark.slow, pytest.mark.betaflight]
RETRIM = [sys.executable, "-m", "retrim.cli"]
STEP = 1.0  # [rad/s]
LOST, GAP = 0.1, 0.02  # [s] limits of lost simulation time and of the sampling interval: beyond, the machine is busy


def skip_if_late(loss, gap=0.0):
    """Skip the test if board, simulation or test were late: the results then do not describe the firmware."""
    if loss > LOST or gap > GAP:
        pytest.skip(f"the machine is busy: the simulation lost {loss:.2f} s, the test {gap:.3f} s")


def test_link_conforms():
    check_vehicle(lambda: Scenario(plant="betaflight").make("small"))


def test_rates_follow_commands_on_every_axis():
    """With wrong signs of the gyroscope, the rates diverge."""
    plant = Scenario(plant="betaflight").make("small")
    try:
        plant.connect()
        for axis in range(3):
            plant.take_off(np.array([0.0, 0.0, 20.0]), 0.0)
            plant.hold(time.monotonic() + 0.5)
            message = np.zeros(4)
            message[0], message[1 + axis] = 9.81, STEP
            plant.send(np.array([9.81, 0.0, 0.0, 0.0]))
            plant.wait(time.monotonic() + 0.3)
            plant.send(message)
            began, after = time.monotonic(), []
            while time.monotonic() < began + 0.6:
                after.append((time.monotonic() - began, plant.read().omega.copy()))
                plant.wait(time.monotonic() + 0.002)
            t, omega = np.array([a for a, _ in after]), np.array([b for _, b in after])
            skip_if_late(plant.lost_time, float(np.diff(t).max()))
            at = [1000 * t[omega[:, axis] > share * STEP][0] for share in (0.1, 0.9)]
            over = 100 * (omega[:, axis].max() / STEP - 1)
            print(f"{'xyz'[axis]}: 10 % after {at[0]:.0f} ms, 90 % after {at[1]:.0f} ms, overshoot {over:.0f} %")
            others = [other for other in range(3) if other != axis]
            assert omega[t > 0.2, axis].mean() == pytest.approx(STEP, abs=0.15)
            assert np.abs(omega[:, others]).max() < 0.5
            assert at[1] < 100
    finally:
        plant.stop()


@pytest.fixture(scope="module")
def policy(tmp_path_factory):
    folder = tmp_path_factory.mktemp("hover")
    subprocess.run([*RETRIM, "pretrain", "hover", "--out", str(folder)], check=True, capture_output=True, timeout=300)
    return folder


def has_realtime_priority():
    """Return whether the system permits real-time scheduling; without it, other processes delay the firmware."""
    before = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
    except OSError:
        return False
    os.sched_setscheduler(0, *before)
    return True


@pytest.mark.skipif(not has_realtime_priority(), reason="SCHED_FIFO is refused here")
@pytest.mark.parametrize(("disturbance", "allowance"), [("none", 0.03), ("small", 0.03), ("large", 0.05)])
def test_flight_adapts_in_real_time(policy, disturbance, allowance, tmp_path):
    words = ["live", "--policy", str(policy), "--plant", "betaflight", "--disturbance", disturbance, "--no-page"]
    process = subprocess.run(
        [*RETRIM, *words, "--seconds", "30", "--out", str(tmp_path)], capture_output=True, text=True, timeout=240
    )
    figures = {row["metric"]: row["value"] for row in json.loads((tmp_path / "results.json").read_text())["rows"]}
    skip_if_late(figures["simulation_lost_s"] or 0.0)
    assert process.returncode == 0, process.stdout
    assert "flight over: landed" in process.stdout
    rows = read_log(tmp_path / "flight.csv")
    flight = rows[rows[:, 1] < 30.0]
    print(f"{disturbance}: steady {figures['steady']:.4f} m, {figures['policies']} policies")
    assert rows[-1, -1] == Mode.LANDED
    assert flight[-1, 1] > 29.0
    assert figures["policies"] > 3
    assert figures["steady"] <= allowance
