"""The process between a flight and remote learners: it forwards the end of the flight and leaves the network."""

import subprocess
import time
from pathlib import Path

import pytest

from bus_ends import await_message
from live_processes import LocalAddress
from retrim.live.processes import bridge as bridge_process
from retrim.live.processes.bridge import BridgePlan
from retrim.onboard.launch import launch
from retrim.onboard.messages import last_note, pack_note
from retrim.onboard.topics import INPUT_TOPICS, OUTPUT_TOPICS
from retrim.transport.shared_memory import SharedMemoryBus

ROOM = dict.fromkeys((*OUTPUT_TOPICS, *INPUT_TOPICS, "sample", "ready.bridge"), 1000)


@pytest.fixture
def bridge_plan():
    """Return the bus of a flight, the network, the supervisor, and the plan of a bridge."""
    here, there = SharedMemoryBus.create(ROOM), SharedMemoryBus.create(ROOM)
    parent = subprocess.Popen(["sleep", "60"])
    yield (
        here,
        there,
        parent,
        BridgePlan(here.folder, LocalAddress("zenoh", "127.0.0.1", 1, folder=there.folder), parent.pid),
    )
    parent.kill()
    parent.wait()
    Path(f"{there.folder}-left").unlink(missing_ok=True)
    here.remove()
    there.remove()


@pytest.fixture
def bridge_case(bridge_plan, tmp_path):
    """Return the same with a running bridge instead of its plan."""
    here, there, parent, plan = bridge_plan
    bridge = launch("retrim.live.processes.bridge:carry", plan, tmp_path / "bridge.log")
    await_message(here, "ready.bridge", patience=30.0)
    yield here, there, parent, bridge
    bridge.kill()
    bridge.wait()


def test_bridge_reports_end_of_flight_without_supervisor(bridge_case):
    here, there, parent, bridge = bridge_case
    here.publish("sample", b"flies")
    parent.kill()
    parent.wait()
    time.sleep(0.5)  # the flight continues, and the vehicle lands
    here.publish("sample", b"flies still")
    assert bridge.poll() is None
    here.publish("ended", pack_note("ended", reason="landed"))
    await_message(there, "ended")
    assert last_note(there, "ended") == {"reason": "landed"}
    assert bridge.wait(bridge_process.SILENCE) == 0  # no supervisor can end it
    assert Path(f"{there.folder}-left").exists()


def test_bridge_without_supervisor_and_flight_exits(bridge_plan, monkeypatch):
    _, there, parent, plan = bridge_plan
    monkeypatch.setattr(bridge_process, "SILENCE", 0.2)
    monkeypatch.setattr(bridge_process.signal, "signal", lambda *_: None)
    parent.kill()
    parent.wait()
    bridge_process.carry(plan)
    assert last_note(there, "ended") == {}


def test_terminated_bridge_leaves_network(bridge_case):
    _, there, _, bridge = bridge_case
    bridge.terminate()
    assert bridge.wait(10.0) == 128 + 15
    assert Path(f"{there.folder}-left").exists()
