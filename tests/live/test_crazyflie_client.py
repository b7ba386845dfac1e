"""Bitcraze's client library flies the simulated Crazyflie. `make test-crazyflie` installs and runs it.

RETRIM_CFLIB names a Python with cflib, which needs other versions of libraries than the tools of this project.
"""

import json
import os
import socket
import subprocess
from pathlib import Path

import pytest

from peers import start_peer, start_process
from retrim import Scenario, testing

CFLIB = os.environ.get("RETRIM_CFLIB", "")
pytestmark = [pytest.mark.slow, pytest.mark.skipif(not CFLIB, reason="RETRIM_CFLIB names no Python with cflib")]
RADIO = Path(__file__).parents[2] / "examples/crazyflie_radio.py"
CLIENT = """
import json, sys, time
import cflib.crtp
from cflib.crazyflie import Crazyflie
from cflib.crazyflie.log import LogConfig
from cflib.crazyflie.syncCrazyflie import SyncCrazyflie

def state(name):
    return rows[-1]["stateEstimateZ." + name]

def manual(roll, pitch, yaw, seconds):
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        cf.commander.send_setpoint_manual(roll, pitch, yaw, float(sys.argv[2]), True)
        time.sleep(0.02)

cflib.crtp.init_drivers()
rows, found = [], {}
with SyncCrazyflie(sys.argv[1], cf=Crazyflie(rw_cache=None)) as connected:
    cf = connected.cf
    found["version"] = cf.platform.get_protocol_version()
    log = LogConfig("state", period_in_ms=20)
    for name in "x y z vx vy vz quat rateRoll ratePitch rateYaw".split():
        log.add_variable("stateEstimateZ." + name)
    cf.log.add_config(log)
    log.data_received_cb.add_callback(lambda t, row, log: rows.append(row))
    log.start()
    time.sleep(1.0)
    found["can be armed"] = cf.supervisor.can_be_armed
    cf.supervisor.send_arming_request(True)
    time.sleep(0.5)
    found["is armed"] = cf.supervisor.is_armed
    cf.high_level_commander.takeoff(1.0, 2.0, yaw=0.5)
    time.sleep(3.0)
    cf.high_level_commander.go_to(0.5, 0.2, 1.2, 0.5, 2.0)
    time.sleep(4.0)
    found["place"], found["quat"] = [state(name) for name in "xyz"], state("quat")
    for axis, name in enumerate(["rateRoll", "ratePitch", "rateYaw"]):
        rates = [0.0, 0.0, 0.0]
        rates[axis] = 20.0
        manual(*rates, 0.3)
        found[name] = state(name)
        rates[axis] = -20.0
        manual(*rates, 0.3)
    cf.commander.send_notify_setpoint_stop()
    cf.high_level_commander.land(0.0, 2.0)
    time.sleep(6.0)
    found["landed"] = not cf.supervisor.is_flying
print(json.dumps(found))
"""


@pytest.fixture
def port():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        result = free.getsockname()[1]
    with start_peer("crazyflie", "--plant", "simple", "--port", result):
        yield result


def test_genuine_client_connects_logs_arms_and_flies_peer(port):
    vehicle = Scenario(plant="simple").make_vehicle("small")
    share = float(9.81 * vehicle.mass / vehicle.thrust_max)
    percent = (share * 65_535 - 10_001) / 499.99 if share * 65_535 > 10_001 else 0.0
    words = [CFLIB, "-c", CLIENT, f"udp://127.0.0.1:{port}", str(percent)]
    process = subprocess.run(words, capture_output=True, text=True, timeout=60)
    assert process.returncode == 0, process.stderr
    result = json.loads(process.stdout.splitlines()[-1])
    assert result["version"] == 12
    assert result["can be armed"]
    assert result["is armed"]
    assert result["place"] == pytest.approx([500, 200, 1200], abs=150)  # [mm]
    rates = [result[name] for name in ("rateRoll", "ratePitch", "rateYaw")]
    # Positive pitch is nose down in the client and in retrim, and nose up in the log of the firmware.
    assert rates == pytest.approx([349, -349, 349], abs=120)  # [mrad/s], 0.3 s after a command of 20 deg/s
    assert result["landed"]


def test_link_through_radio_script_conforms(port):
    other = port + 1 if port < 65_000 else port - 1
    with start_process(CFLIB, RADIO, f"udp://127.0.0.1:{port}", other):
        testing.check_vehicle(lambda: Scenario(plant=f"crazyflie:udp:127.0.0.1:{other}").make("small"))
