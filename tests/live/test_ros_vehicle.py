"""A vehicle behind ROS 1: conformance, and a flight that adapts. `make test-ros` installs ROS and runs the tests."""

import json
import subprocess
import sys

import numpy as np
import pytest

from peers import start_peer
from retrim import PlantError, Scenario, testing
from retrim.onboard.guard import Mode
from retrim.onboard.recorder import read_log
from retrim.ros1 import plant as ros
from retrim.ros1.link import attitude_target
from retrim.testing.vehicle import HEADING
from retrim_paper.latency import rosmaster

pytestmark = pytest.mark.slow
RETRIM = [sys.executable, "-m", "retrim.cli"]


@pytest.fixture(scope="module")
def master():
    with rosmaster() as result:
        if result is None:
            pytest.skip("needs rosmaster and rospy: make test-ros installs them")
        yield f"{result.host}:{result.port}"


def test_targets_equal_those_of_mavros(master):
    assert attitude_target()._md5sum == "456f3af666b22ccd0222ea053a86b548"


@pytest.mark.parametrize("more", [(), ("--poses",)], ids=["odometry", "poses alone"])
def test_link_conforms(master, more):
    place = (0.3, -0.2, 1.5)
    with start_peer("ros", f"http://{master}", "--plant", "simple", "--place", *place, "--yaw", HEADING, *more):
        testing.check_vehicle(lambda: Scenario(plant=f"ros:{master}").make("small"), place=place)


def test_missing_topics_are_named(master, monkeypatch):
    monkeypatch.setattr(ros, "WAIT_S", 0.3)
    plant, why = Scenario(plant=f"ros:{master}/elsewhere").make("small"), r"neither /elsewhere/.* came in 0\.3 s"
    with plant, pytest.raises(PlantError, match=why):
        plant.connect()


def test_flight_adapts_under_large_disturbance(master, tmp_path):
    policy, flight = tmp_path / "policy", tmp_path / "flight"
    words = [*RETRIM, "pretrain", "hover", "--preset", "hover/retrim", "--out", str(policy)]
    subprocess.run(words, check=True, capture_output=True, timeout=300)
    with start_peer("ros", f"http://{master}", "--disturbance", "large"):
        words = [*RETRIM, "live", "--policy", str(policy), "--plant", f"ros:{master}", "--seconds", "20"]
        process = subprocess.run([*words, "--out", str(flight)], capture_output=True, text=True, timeout=240)
    assert process.returncode == 0, process.stdout
    figures = {row["metric"]: row["value"] for row in json.loads((flight / "results.json").read_text())["rows"]}
    rows = read_log(flight / "flight.csv")
    late = rows[(rows[:, 1] > 15.0) & (rows[:, -1] == Mode.POLICY)]
    assert "flight over: landed" in process.stdout
    assert figures["policies"] > 10
    assert figures["refused_messages"] == 0
    assert np.linalg.norm(late[:, 3:6] - [0.0, 0.0, 1.0], axis=1).mean() < 0.05
