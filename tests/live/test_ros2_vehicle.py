"""Vehicles behind a genuine ROS 2 node: conformance, whole flights that adapt, and the outcome of each fault.

``RETRIM_ROS2`` names the Python of an environment with rclpy and retrim; `make test-ros2` creates it and runs the
tests. The node of the peer uses rclpy with Fast DDS, which serialises odometry and poses. The package index does not
have px4_msgs and mavros_msgs; ``tests/ros2_packages`` contains replacements with the same names and hashes.
"""

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from peers import start_process
from retrim.onboard.guard import Mode
from retrim.onboard.recorder import read_log
from retrim.ros2.message_type import message_type
from retrim.testing.vehicle import HEADING
from retrim_paper.latency import free_port

ROS2 = os.environ.get("RETRIM_ROS2", "")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.ros2,
    pytest.mark.skipif(not ROS2, reason="needs RETRIM_ROS2, a Python with rclpy: make test-ros2 makes one"),
]
PACKAGES = Path(__file__).parents[1] / "ros2_packages"
RETRIM = ("-P", "-m", "retrim.cli")
HOME = np.array([0.0, 0.0, 1.0])
BUSY = 0.05  # largest share of ticks of the watchdog on a machine with other work
PLACE = ("--place", "0.3", "-0.2", "1.5", "--yaw", str(HEADING))


@pytest.fixture(autouse=True)
def limit_discovery(monkeypatch):
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    monkeypatch.setenv("ROS_DOMAIN_ID", str(20 + os.getpid() % 60))
    monkeypatch.setenv("PYTHONPATH", str(PACKAGES))


def start_rclpy_peer(*words):
    """Start a vehicle behind rclpy."""
    return start_process(ROS2, "-P", PACKAGES / "genuine_peer.py", *words)


def start_zenoh_peer(port, *words):
    """Start a simulated vehicle behind zenoh, which rclpy of the package index does not have."""
    return start_process(
        sys.executable, "-P", "-m", "retrim.testing.ros2_peer", *words, "--listen", f"127.0.0.1:{port}"
    )


@contextlib.contextmanager
def start_vehicle(backend, dialect, *words):
    """Start a vehicle; yield its process and its address for a back end."""
    if backend == "zenoh":
        port = free_port()
        with start_zenoh_peer(port, dialect, *words) as process:
            yield process, f"ros2:zenoh@127.0.0.1:{port}:{dialect}"
    else:
        with start_rclpy_peer(dialect, *words) as process:
            yield process, f"ros2:{backend}:{dialect}"


def python_of(backend):
    return ROS2 if backend == "rclpy" else sys.executable


# ---- conformance

CASES = [(backend, *case) for backend in ("rclpy", "cyclonedds", "zenoh") for case in (("px4", ()), ("mavros", PLACE))]
CASES += [("cyclonedds", "px4", ("--reports-thrust",)), ("cyclonedds", "mavros", (*PLACE, "--poses"))]
HASHES = """
import sys
from retrim.ros2.message_type import message_type
from retrim.ros2.node import SENSOR
from retrim.ros2.rclpy_node import RclpyNode

node = RclpyNode()
for k, name in enumerate(sys.argv[1:]):
    node.advertise(f"/a{k}", message_type(name), SENSOR)
    print(node._endpoints(f"/a{k}")[0][0].type_hash)
"""


@pytest.mark.parametrize(("backend", "dialect", "words"), CASES, ids=[f"{a} {b} {c[-1:]}" for a, b, c in CASES])
def test_link_conforms(backend, dialect, words):
    with start_vehicle(backend, dialect, "--plant", "simple", *words) as (_, address):
        done = subprocess.run(
            [python_of(backend), "-P", PACKAGES / "conform.py", address], capture_output=True, text=True, timeout=200
        )
    assert done.returncode == 0, done.stderr[-2000:]
    assert "it conforms" in done.stdout


def test_hashes_equal_those_of_this_rclpy():
    names = ("nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped", "std_msgs/msg/UInt8MultiArray")
    done = subprocess.run([ROS2, "-P", "-c", HASHES, *names], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout.split() == [message_type(name).hash for name in names]


# ---- flights


@pytest.fixture(scope="module")
def policy(tmp_path_factory):
    folder = tmp_path_factory.mktemp("policy")
    words = [sys.executable, *RETRIM, "pretrain", "hover", "--preset", "hover/retrim", "--out", str(folder)]
    subprocess.run(words, check=True, capture_output=True, timeout=300)
    return folder


def fly(policy, address, out, *words, backend="cyclonedds", seconds=20):
    command = [python_of(backend), *RETRIM, "live", "--policy", str(policy), "--plant", address, "--out", str(out)]
    return subprocess.Popen([*command, "--seconds", str(seconds), *words], stdout=subprocess.PIPE, text=True)


def output_of(flight, *, fails=False):
    text = flight.communicate(timeout=240)[0]
    assert (flight.returncode != 0) == fails, text
    return text


def read_results(out):
    """Return the figures and the log of a flight."""
    rows = json.loads((out / "results.json").read_text())["rows"]
    return {row["metric"]: row["value"] for row in rows}, read_log(out / "flight.csv")


def error(rows, since):
    """Return the distance from the goal at each tick of the policy [m]."""
    late = rows[(rows[:, 1] >= since) & (rows[:, -1] == Mode.POLICY)]
    return np.linalg.norm(late[:, 3:6] - HOME, axis=1)


@pytest.mark.parametrize(
    ("backend", "dialect"),
    [("rclpy", "mavros"), ("cyclonedds", "px4"), ("cyclonedds", "mavros"), ("zenoh", "px4")],
)
def test_flight_adapts_under_large_disturbance_as_in_lockstep(backend, dialect, policy, tmp_path):
    with start_vehicle(backend, dialect, "--disturbance", "large") as (_, address):
        text = output_of(fly(policy, address, tmp_path, backend=backend))
    figures, rows = read_results(tmp_path)
    print(f"{backend}, {dialect}: {error(rows, 15.0).mean():.4f} m, {figures['policies']} policies")
    assert "flight over: landed" in text
    assert figures["policies"] > 10
    assert figures["fallback_ticks"] <= BUSY * len(rows)
    assert figures["refused_messages"] == 0
    assert error(rows, 15.0).mean() < 0.01


IRREGULARITIES = {
    "20 Hz": ("--rate", "20"), "50 Hz": ("--rate", "50"), "200 Hz": ("--rate", "200"), "out of order": ("--scrambled",),
    "clock set back": ("--clock-jump", "6", "-1000"), "clock set forward": ("--clock-jump", "6", "1000"),
}  # fmt: skip


@pytest.mark.parametrize("irregularity", IRREGULARITIES)
def test_flight_survives_irregular_messages(irregularity, policy, tmp_path):
    with start_vehicle("cyclonedds", "mavros", "--disturbance", "large", *IRREGULARITIES[irregularity]) as (_, address):
        text = output_of(fly(policy, address, tmp_path))
    figures, rows = read_results(tmp_path)
    print(f"{irregularity}: {error(rows, 15.0).mean():.4f} m")
    assert "flight over: landed" in text
    assert figures["fallback_ticks"] <= BUSY * len(rows)
    assert error(rows, 15.0).mean() < (0.05 if irregularity == "20 Hz" else 0.02)


def wait_for_flight(out, seconds):
    """Wait for a time of the flight [s]."""
    end = time.monotonic() + 120.0
    while time.monotonic() < end:
        with contextlib.suppress(OSError, ValueError, IndexError):
            if read_log(out / "flight.csv")[-1, 1] > seconds:
                return
        time.sleep(0.2)
    raise AssertionError("no flight began")


def test_killed_vehicle_ends_flight_and_successor_is_unaffected(policy, tmp_path):
    with start_vehicle("cyclonedds", "mavros") as (process, address):
        flight = fly(policy, address, tmp_path, seconds=60)
        wait_for_flight(tmp_path, 5.0)
        process.send_signal(signal.SIGKILL)
        text = output_of(flight, fails=True)
    _, rows = read_results(tmp_path)
    assert "plant lost: no state has come for 1.5 s; the other pilot has control again" in text
    assert rows[-1, 1] < 12.0
    # the network still lists the killed vehicle
    with start_vehicle("cyclonedds", "mavros") as (_, address):
        text = output_of(fly(policy, address, tmp_path / "again", seconds=5))
    assert "flight over: landed" in text


def refusal(policy, address, out):
    text = output_of(fly(policy, address, out, seconds=5), fails=True)
    assert len([line for line in text.splitlines() if "use the same" in line or "name the firmware" in line]) == 1, text
    return text


def test_another_release_of_px4_is_refused_until_it_is_named(policy, tmp_path, monkeypatch):
    monkeypatch.setenv("RETRIM_PX4_MSGS", "1.14")
    with start_rclpy_peer("px4", "--release", "1.14"):
        text = refusal(policy, "ros2:cyclonedds:px4", tmp_path / "newest")
        assert "px4_msgs 1.14 (before 1.15)" in text
        assert "px4_msgs 1.15 or later" in text
        text = output_of(fly(policy, "ros2:cyclonedds:px4-1.14", tmp_path / "named", seconds=5))
    assert "flight over: landed" in text


def test_another_version_of_mavros_msgs_is_refused_with_both_names(policy, tmp_path, monkeypatch):
    monkeypatch.setenv("RETRIM_OTHER_HASH", "RIHS01_" + 32 * "ab")
    with start_rclpy_peer("mavros"):
        text = refusal(policy, "ros2:cyclonedds:mavros", tmp_path)
    assert "an unknown version (RIHS01_abababab...) at the other end, and of mavros_msgs 1 and 2 here" in text
