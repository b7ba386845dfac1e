"""From a flight by hand to a hover through Betaflight's firmware by MSP override; `make test-betaflight` runs it."""

import json
import os
import signal
import time
import tomllib
from pathlib import Path

import numpy as np
import pytest

from msp_rig import flight, identify, run
from retrim.onboard.guard import Mode
from retrim.onboard.recorder import read_log

pytestmark = [pytest.mark.slow, pytest.mark.betaflight]


@pytest.fixture(scope="module")
def identified(tmp_path_factory):
    return identify(tmp_path_factory.mktemp("manual"))


@pytest.fixture(scope="module")
def policy(identified, tmp_path_factory):
    folder = tmp_path_factory.mktemp("hover")
    run("pretrain", "hover", "--vehicle", str(identified), "--out", str(folder))
    return folder


def wait_for_rows(out, count):
    until = time.monotonic() + 60.0
    while not (out / "flight.csv").exists() or len((out / "flight.csv").read_text().splitlines()) < count:
        assert time.monotonic() < until
        time.sleep(0.1)


def test_log_of_manual_flight_identifies_rate_loop(identified):
    file = tomllib.loads(identified.read_text())
    assert 0.005 < file["rate_lag"][0] < 0.06
    assert 0.01 < file["motor_tau"] < 0.06
    assert file["mass"] == 0.72


@pytest.mark.parametrize(("disturbance", "allowance"), [("none", 0.02), ("large", 0.02)])
def test_hover_adapts_and_ends_on_ground(policy, disturbance, allowance, tmp_path):
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


def test_pilot_takes_over_with_switch(policy, tmp_path):
    with flight(policy, tmp_path, "--adapt", "none") as (process, pilot):
        wait_for_rows(tmp_path, 150)
        pilot.turn_switch()
        process.wait(60.0)
        assert "the pilot has switched MSP OVERRIDE off, and flies" in (tmp_path / "output.txt").read_text()
        time.sleep(3.0)
        height, tilt = pilot.end()
    assert height == pytest.approx(1.0, abs=0.2)
    assert tilt < 10.0


def test_guardian_lowers_vehicle_level_after_processes_are_killed(policy, tmp_path):
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
