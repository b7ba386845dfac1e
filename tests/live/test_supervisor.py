"""The end of a flight: the supervisor waits for processes that must still send messages, while they live."""

import threading
import time

import pytest

from live.test_faults import controller, make_spec  # noqa: F401
from live_processes import DT
from retrim.live import remote_learners
from retrim.live.supervisor import Supervisor
from retrim.onboard.messages import last_note, pack_note
from retrim.transport.network import FAREWELL
from retrim.transport.remote import Address
from retrim.transport.shared_memory import SharedMemoryBus

ADDRESS = Address("zenoh", "127.0.0.1", 1)


def run_ground(folder, base, reasons):
    """Remote learners that confirm the end of the flight late."""
    bus = SharedMemoryBus(folder)
    while not (end_note := last_note(bus, "ended")):
        bus.publish("ground", pack_note("ground", base=base, alive={"policy": True}))
        time.sleep(0.02)
    until = time.monotonic() + 3 * FAREWELL
    while time.monotonic() < until:
        bus.publish("ground", pack_note("ground", base="of another flight", alive={"policy": True}, over=True))
        time.sleep(0.02)
    if folder.exists():
        reasons.append(end_note["reason"])
    bus.publish("ground", pack_note("ground", base=base, alive={}, over=True))
    bus.close()


@pytest.mark.parametrize("reason", ["landed", None])
def test_remote_learners_receive_end_before_bridge_exits(tmp_path, controller, reason):  # noqa: F811
    reasons = list[str]()
    with Supervisor(make_spec(tmp_path, controller, learners=ADDRESS)) as flight:
        ground = threading.Thread(target=run_ground, args=(flight.bus.folder, controller.base, reasons))
        ground.start()
        while flight.bus.latest("ground") is None:
            time.sleep(0.01)
        if reason:
            flight.bus.publish("ended", pack_note("ended", reason=reason))
    assert reasons == [reason or "the flight did not come to its end"]
    ground.join()


def test_supervisor_does_not_wait_for_lost_remote_learners(tmp_path, controller, monkeypatch):  # noqa: F811
    monkeypatch.setattr(remote_learners, "PARTING_TIME", 1000.0)
    with Supervisor(make_spec(tmp_path, controller, learners=ADDRESS)) as flight:
        folder = flight.bus.folder
        flight.bus.publish("ground", pack_note("ground", base=controller.base, alive={"policy": True}))
        began = time.monotonic()
    assert time.monotonic() > began + FAREWELL  # a message always has time for transmission
    assert not folder.exists()


class FakeProcess:
    """A process that runs until its termination."""

    def __init__(self, runs=True):
        self.stop_time, self._code = None, None if runs else 0

    def poll(self):
        return self._code

    def wait(self, patience=None):
        return self._code

    def kill(self):
        self._code = -9

    def terminate(self):
        self.stop_time, self._code = time.monotonic(), -15


def test_control_has_time_to_publish_last_rows_after_plant_ends(tmp_path, controller):  # noqa: F811
    with Supervisor(make_spec(tmp_path, controller)) as flight:
        control = FakeProcess()
        flight.processes = {"recorder": FakeProcess(), "control": control, "plant": FakeProcess(runs=False)}
        began = time.monotonic()
        flight.finish(patience=1.0)
        assert began + 3 * DT < control.stop_time < began + 1.0
