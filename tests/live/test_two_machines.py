"""Flights with learners on another machine: over zenoh and ROS 2 between two namespaces, and over ROS 1."""

import json
import subprocess
import sys
from contextlib import ExitStack

import pytest

from retrim_paper.latency import free_port, rosmaster, two_machines

pytestmark = pytest.mark.slow
RETRIM = [sys.executable, "-m", "retrim.cli"]


@pytest.fixture(scope="module")
def policy(tmp_path_factory):
    folder = tmp_path_factory.mktemp("policy")
    words = [*RETRIM, "pretrain", "hover", "--preset", "hover/retrim", "--out", str(folder)]
    subprocess.run(words, check=True, capture_output=True, timeout=300)
    return folder


@pytest.mark.parametrize("network", ["zenoh between namespaces", "ROS 2 between namespaces", "ROS 1"])
def test_flight_uses_learners_on_another_machine(policy, tmp_path, network, monkeypatch):
    with ExitStack() as stack:
        if network == "ROS 1":
            master = stack.enter_context(rosmaster())
            if master is None:
                pytest.skip("needs rosmaster and rospy: make test-ros installs them")
            address, inside = f"ros:{master.host}:{master.port}", ()
        else:
            machines = stack.enter_context(two_machines())
            if machines is None:
                pytest.skip("needs the right to make network namespaces")
            address, inside = f"zenoh:{machines[0]}:7447", machines[1]
            if network.startswith("ROS 2"):
                pytest.importorskip("cyclonedds")
                there, inside = (
                    machines[0].rpartition(".")[0] + ".2",
                    [*inside, "env", f"ROS_STATIC_PEERS={machines[0]}"],
                )
                monkeypatch.setenv("ROS_STATIC_PEERS", there)
                address = "ros2:42/quad1"
        key = tmp_path / "key"
        key.write_text("a key that both ends have\n")
        words = [*RETRIM, "live", "--policy", str(policy), "--disturbance", "large", "--seconds", "20", "--learners"]
        flight = subprocess.Popen(
            [*words, address, "--key", str(key), "--out", str(tmp_path)], stdout=subprocess.PIPE, text=True
        )
        ground = subprocess.Popen(
            [*inside, *RETRIM, "learn", address, "--key", str(key)], stdout=subprocess.PIPE, text=True
        )
        text, reply = flight.communicate(timeout=300)[0], ground.communicate(timeout=60)[0]
    assert flight.returncode == 0, text
    assert ground.returncode == 0, reply
    assert "flight over: landed" in reply
    assert ("warning: this machine listens on" in text) == (network != "ROS 1")
    result = {row["metric"]: row["value"] for row in json.loads((tmp_path / "results.json").read_text())["rows"]}
    assert result["policies"] > 10
    print(f"{network}: {result['flight_to_swap_s']:.2f} s from flight to swap")
    assert result["flight_to_swap_s"] < 1.0
    assert result["steady"] < 0.01
    assert result["fallback_ticks"] == 0
    assert result["refused_messages"] == 0


def test_one_ground_process_learns_for_two_vehicles_as_between_namespaces(policy, tmp_path):
    """Two flights over zenoh on this machine have low-rank policies with a common base."""
    pytest.importorskip("zenoh")
    where = [f"zenoh:127.0.0.1:{free_port()}" for _ in range(2)]
    words = [*RETRIM, "live", "--policy", str(policy), "--plant", "simple", "--disturbance", "large", "--seconds", "25"]
    more = [
        ["--learners", address, "--adapt", "lora", "--out", str(tmp_path / f"{i}")] for i, address in enumerate(where)
    ]
    ground = subprocess.Popen([*RETRIM, "learn", *where], stdout=subprocess.PIPE, text=True)
    flights = [subprocess.Popen([*words, *each], stdout=subprocess.PIPE, text=True) for each in more]
    text = [flight.communicate(timeout=300)[0] for flight in flights]
    reply = ground.communicate(timeout=60)[0]
    assert [flight.returncode for flight in flights] == [0, 0], text
    assert ground.returncode == 0, reply
    assert reply.count("flight over: landed") == 2
    for i in range(2):
        rows = json.loads((tmp_path / f"{i}" / "results.json").read_text())["rows"]
        result = {row["metric"]: row["value"] for row in rows}
        assert result["policies"] > 3
        assert result["flight_to_swap_s"] < 1.5
        assert result["steady"] < 0.01
        assert result["refused_messages"] == 0
