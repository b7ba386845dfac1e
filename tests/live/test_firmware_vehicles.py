"""Vehicles with unknown rate controllers, through Betaflight's and PX4's firmware; `make test-vehicles` flies them.

The commands are those of docs/how-to/from-the-box.md.
"""

import json
import subprocess
import sys

import numpy as np
import pytest

from msp_rig import RETRIM, VEHICLE, flight, identify, run
from peers import start_process
from px4_rig import ADDRESS, PX4, SIH, X500, Changes, wait_until
from retrim.onboard.guard import Mode
from retrim.onboard.recorder import read_log

pytestmark = pytest.mark.slow
HOME = np.array([0.0, 0.0, 1.0])
GAINS = {
    "p_roll": 45, "i_roll": 80, "d_roll": 30, "d_max_roll": 40,
    "p_pitch": 47, "i_pitch": 84, "d_pitch": 34, "d_max_pitch": 46,
    "p_yaw": 45, "i_yaw": 80,
}  # fmt: skip
"""Betaflight's default gains."""


def figures_of(folder):
    return {row["metric"]: row["value"] for row in json.loads((folder / "results.json").read_text())["rows"]}


def error(rows, since, until=1e9):
    """True distance from the place of the hover at each tick of the policy [m]."""
    rows = rows[(rows[:, 1] >= since) & (rows[:, 1] < until) & (rows[:, -1] == Mode.POLICY)]
    return np.linalg.norm(rows[:, 18:21] - HOME, axis=1)


# ---- Betaflight


@pytest.fixture(scope="module", params=[0.3, 1.0, 2.0])
def settings(request):
    """Options of the peer for gains that are multiplied by a factor."""
    return [word for name, x in GAINS.items() for word in ("--set", f"{name}={min(250, round(request.param * x))}")]


@pytest.fixture(scope="module")
def any_policy(tmp_path_factory):
    folder = tmp_path_factory.mktemp("any")
    run("pretrain", "hover", "--preset", "hover/any", "--vehicle", VEHICLE, "--out", str(folder))
    return folder


def hover(policy, out, settings, *words):
    with flight(policy, out, *words, pilot=("--disturbance", "large", *settings)) as (process, _):
        process.wait(120.0)
        text = (out / "output.txt").read_text()
    assert process.returncode == 0, text
    assert "flight over: landed" in text
    figures = figures_of(out)
    print(f"{words}: steady {figures['steady']} m\n{text}")
    assert figures["steady"] is not None, text
    assert figures["steady"] <= 0.03


@pytest.mark.betaflight
def test_identified_vehicle_hovers_under_large_push(settings, tmp_path):
    path = identify(tmp_path, *settings)
    print(path.read_text())
    run("pretrain", "hover", "--vehicle", str(path), "--out", str(tmp_path / "hover"))
    hover(tmp_path / "hover", tmp_path / "flight", settings)


@pytest.mark.betaflight
def test_unknown_vehicle_hovers_under_large_push(settings, any_policy, tmp_path):
    hover(any_policy, tmp_path / "flight", settings, "--adapt", "base-id")


# ---- PX4


def start_px4(gain, *words):
    """Start PX4, whose rate controllers have other gains."""
    settings = [word for axis in ("ROLL", "PITCH", "YAW") for word in ("--set", f"MC_{axis}RATE_K={gain}")]
    return start_process(sys.executable, "-m", "retrim.testing.px4", PX4, *settings, *words)


def start_flight(policy, out, seconds, *words):
    command = [*RETRIM, "live", "--policy", str(policy), "--plant", ADDRESS, "--no-page"]
    command += ["--seconds", str(seconds), "--out", str(out), *words]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True)


def fly_px4(policy, out, gain, *words, seconds=30):
    """Hover in PX4's own simulation; a load of 30 % begins after 10 s."""
    with start_px4(gain):
        changes, process = Changes(), start_flight(policy, out, seconds, *words)
        try:
            changes.set_at(out / "flight.csv", 10.0, process, SIH_MASS=1.3)
        finally:
            changes.link.close()
        text = process.communicate(timeout=240)[0]
    rows = read_log(out / "flight.csv")
    print(f"gains x {gain}, {words}: {[round(float(error(rows, t, t + 5).mean()), 3) for t in range(0, seconds, 5)]}")
    assert process.returncode == 0, text
    assert "flight over: landed" in text
    return rows


@pytest.mark.px4
@pytest.mark.skipif(not PX4, reason="RETRIM_PX4 names no unpacked PX4")
@pytest.mark.parametrize("gain", [0.5, 2.0])
def test_px4_with_other_rate_gains_hovers_with_a_load(gain, tmp_path):
    """The first flight, with the policy for many vehicles, identifies the vehicle; the second has its own policy."""
    run("pretrain", "hover", "--preset", "hover/any", "--vehicle", SIH, "--out", str(tmp_path / "any"))
    rows = fly_px4(tmp_path / "any", tmp_path / "first", gain, "--adapt", "base-id")
    assert error(rows, 13.0).mean() < 0.06
    words = ("--identify", "--policy", str(tmp_path / "any"), "--out", str(tmp_path / "id"))
    run("replay", str(tmp_path / "first/flight.csv"), *words)
    print((tmp_path / "id/vehicle.toml").read_text())
    run("pretrain", "hover", "--vehicle", str(tmp_path / "id/vehicle.toml"), "--out", str(tmp_path / "hover"))
    rows = fly_px4(tmp_path / "hover", tmp_path / "second", gain)
    assert error(rows, 13.0).mean() < 0.06


@pytest.fixture(scope="module")
def x500_policy(tmp_path_factory):
    folder = tmp_path_factory.mktemp("x500")
    run("pretrain", "hover", "--preset", "hover/any", "--vehicle", X500, "--out", str(folder))
    return folder


@pytest.mark.px4
@pytest.mark.skipif(not PX4, reason="RETRIM_PX4 names no unpacked PX4")
@pytest.mark.parametrize("gain", [0.5, 1.0, 2.0])
def test_px4_with_other_rate_gains_hovers_under_large_push(gain, x500_policy, tmp_path):
    """PX4's firmware flies a vehicle with blade-element rotors; the push begins after 8 s."""
    with start_px4(gain, "--vehicle", X500, "--disturbance", "large") as peer:
        process = start_flight(x500_policy, tmp_path, 20, "--adapt", "base-id")
        wait_until(tmp_path / "flight.csv", 8.0, process)
        peer.stdin.write("\n")
        peer.stdin.flush()
        text = process.communicate(timeout=240)[0]
    rows = read_log(tmp_path / "flight.csv")
    print(f"gains x {gain}: mean error {[round(float(error(rows, t, t + 1).mean()), 4) for t in range(20)]}")
    assert process.returncode == 0, text
    assert "flight over: landed" in text
    assert error(rows, 13.0).mean() < 0.006  # the true position is rounded to 11 mm
    assert error(rows, 13.0).max() < 0.02
