"""The process between a flight and its learners elsewhere: it carries the end of a flight, and leaves the network."""

import subprocess
import time
from dataclasses import dataclass
from pathlib import Path

import pytest

from bus_ends import arrived
from retrim.live import bridge_process
from retrim.live.bridge_process import BridgePlan
from retrim.onboard.launch import launch
from retrim.onboard.messages import last_note, pack_note
from retrim.onboard.topics import INTO, OUT
from retrim.transport.remote import Address
from retrim.transport.shared_memory import SharedMemoryBus

ROOM = dict.fromkeys((*OUT, *INTO, "sample", "ready.bridge"), 1000)


class Left(SharedMemoryBus):
    """A bus in place of a network, which notes that somebody left it, and what was declared."""

    def close(self):
        if self._maps:
            (self.folder.parent / f"{self.folder.name}-left").touch()
        super().close()


@dataclass(frozen=True)
class Beside(Address):
    """Its network is a bus of this machine."""

    folder: Path = Path()

    def join(self, capacities, *, listen, writes=()):
        assert listen
        assert set(writes) == set(OUT)
        return Left(self.folder)


@pytest.fixture
def carried(tmp_path):
    """The flight's bus, the network, the supervisor and the bridge, which carries already."""
    here, there = SharedMemoryBus.create(ROOM), SharedMemoryBus.create(ROOM)
    parent = subprocess.Popen(["sleep", "60"])
    plan = BridgePlan(here.folder, Beside("zenoh", "127.0.0.1", 1, folder=there.folder), parent.pid)
    bridge = launch("retrim.live.bridge_process:carry", plan, tmp_path / "bridge.log")
    arrived(here, "ready.bridge", patience=30.0)
    yield here, there, parent, bridge
    for process in (parent, bridge):
        process.kill()
        process.wait()
    Path(f"{there.folder}-left").unlink(missing_ok=True)
    here.remove()
    there.remove()


def test_a_flight_that_lost_its_supervisor_tells_the_ground_how_it_ended(carried):
    here, there, parent, bridge = carried
    here.publish("sample", b"flies")
    parent.kill()
    parent.wait()
    time.sleep(0.5)  # the vehicle goes on, and lands
    here.publish("sample", b"flies still")
    assert bridge.poll() is None
    here.publish("ended", pack_note("ended", reason="landed"))
    arrived(there, "ended")
    assert last_note(there, "ended") == {"reason": "landed"}
    assert bridge.wait(bridge_process.SILENCE) == 0  # nobody is left to end it
    assert Path(f"{there.folder}-left").exists()


def test_without_a_supervisor_and_a_flight_it_ends(carried, monkeypatch):
    here, there, parent, _ = carried
    monkeypatch.setattr(bridge_process, "SILENCE", 0.2)
    monkeypatch.setattr(bridge_process.signal, "signal", lambda *_: None)
    parent.kill()
    parent.wait()
    plan = BridgePlan(here.folder, Beside("zenoh", "127.0.0.1", 1, folder=there.folder), parent.pid)
    bridge_process.carry(plan)
    assert last_note(there, "ended") == {}


def test_a_bridge_that_is_told_to_end_leaves_the_network(carried):
    _, there, _, bridge = carried
    bridge.terminate()
    assert bridge.wait(10.0) == 128 + 15
    assert Path(f"{there.folder}-left").exists()
