"""Learners on another machine: a flight uses their policies and survives the loss of learners, bridge or page."""

import os
import signal
import threading
import time

import numpy as np
import pytest

from live.test_faults import controller, make_spec, read_whole_log  # noqa: F401
from live_helpers import DrillSupervisor
from live_processes import HOME, DrillPlan, level
from retrim.config import PRESETS, changed
from retrim.config.loading import dump
from retrim.errors import ConfigError, MessageError, PlantError
from retrim.live import learner_server as ground
from retrim.live import remote_learners
from retrim.live.events import LiveEvents
from retrim.live.learner_mission import LearnerMission
from retrim.live.learner_server import LearnerServer, learn_for
from retrim.live.operator.page import free_port
from retrim.live.spec import PageSpec
from retrim.onboard.guard import Mode
from retrim.onboard.launch import launch
from retrim.onboard.messages import last_note, pack_note
from retrim.onboard.topics import INPUT_TOPICS, OUTPUT_TOPICS
from retrim.transport.bridge import LEAST_INTERVAL, Bridge
from retrim.transport.in_process import InProcessBus
from retrim.transport.message import pack_arrays
from retrim.transport.remote import Address
from retrim.transport.session import FOREIGN_KEY, MISSING_KEY, UNSIGNED
from retrim.transport.shared_key import SharedKey
from retrim_paper.latency import free_port as unused_port

SECONDS = 2.4
KEY, OTHER = SharedKey(b"k" * 32), SharedKey(b"o" * 32)


class DrillGround(LearnerServer):
    """A ground station with the learners of a drill."""

    def _start(self, layer):
        plan = DrillPlan(self._bus.folder, os.getpid(), layer, level(), self._mission.base)
        self.processes[layer] = launch("live_processes:learner", plan, self.folder / f"{layer}.log")


def run_station(address, over):
    """Run a ground station until ``over`` is set."""
    with DrillGround(address) as ground:
        for _ in ground.wait():
            time.sleep(0.02)
            if over.is_set():
                return
        for _ in ground.learn():
            if not ground.has_traffic:
                time.sleep(0.002)
            if over.is_set():
                return


def fly_with_loss(gap, folder, controller):  # noqa: F811
    """Fly with learners at a ground station, and end ``gap`` after a second.

    Returns:
        The last status, the events, and the mode at each tick before the landing.
    """
    address, over = Address("zenoh", "127.0.0.1", unused_port(), shared=KEY), threading.Event()
    page = PageSpec("127.0.0.1", free_port("127.0.0.1", 18180), "drill", HOME[None].repeat(2, 0), (), 0.06, 0.19)
    changes = {"learners": address, "seconds": 20.0, "page": page if gap == "bridge and page" else None}
    thread = threading.Thread(target=run_station, args=(address, over))
    thread.start()
    events, intact = LiveEvents(), True
    try:
        with DrillSupervisor(make_spec(folder, controller, **changes)) as drill:
            for _ in drill.warm_up():
                pass
            drill.take_off()
            while (status := drill.watch()).end_reason is None and status.t < 20.0:
                events.take(status)
                if status.t > 1.0 and intact:
                    intact = False
                    if gap == "ground":
                        over.set()
                    else:
                        drill.processes["bridge"].kill()
                        os.kill(drill.processes["page"].pid, signal.SIGSTOP)  # it hangs
                is_restored = gap == "ground" or status.restarts.keys() == {"bridge", "page"}
                if status.t > (SECONDS if is_restored else 10.0):
                    drill.land()
                time.sleep(0.02)
            drill.finish()
    finally:
        over.set()
        thread.join(20.0)
    rows = read_whole_log(folder, status)
    assert status.end_reason == "landed"
    return status, events, rows[rows[:, 1] < SECONDS - 0.1, -1]


@pytest.mark.parametrize("gap", ["ground", "bridge and page"])
def test_flight_uses_remote_learners(tmp_path, controller, gap):  # noqa: F811
    pytest.importorskip("zenoh")
    for attempt in ("first", "second", "third"):  # on a busy machine, control may be late, and the watchdog takes over
        (tmp_path / attempt).mkdir()
        status, events, modes = fly_with_loss(gap, tmp_path / attempt, controller)
        if (share := np.mean(modes == Mode.POLICY)) > 0.9:
            break
    assert share > 0.9
    swaps = [at for at, half, *_ in events.swaps if half == "policy"]
    assert swaps
    assert swaps[0] < 1.0
    if gap == "ground":
        assert swaps[-1] < 2.0
        assert not status.alive["policy"]
    else:
        assert swaps[-1] > 2.0
        assert status.restarts == {"bridge": 1, "page": 1}
        assert status.hangs == {"page": 1}


@pytest.mark.parametrize(
    ("here", "there", "error_here", "error_there"),
    [(KEY, OTHER, FOREIGN_KEY, FOREIGN_KEY), (None, KEY, MISSING_KEY, UNSIGNED), (KEY, None, UNSIGNED, MISSING_KEY)],
    ids=("another", "none here", "none there"),
)
def test_wrong_or_missing_key_prevents_flight_and_both_ends_report_it(
    tmp_path, monkeypatch, request, here, there, error_here, error_there
):
    pytest.importorskip("zenoh")
    for module in (ground, remote_learners):
        monkeypatch.setattr(module, "DISTRUST", 0.5)
    port, errors, source = unused_port(), [], request.getfixturevalue("controller")

    def listen():
        try:
            run_station(Address("zenoh", "127.0.0.1", port, shared=there), threading.Event())
        except ConfigError as error:
            errors.append(str(error))

    thread = threading.Thread(target=listen)
    thread.start()
    address = Address("zenoh", "127.0.0.1", port, shared=here)
    with (
        DrillSupervisor(make_spec(tmp_path, source, learners=address)) as drill,
        pytest.raises(PlantError) as error,
    ):
        for _ in drill.warm_up():
            pass
    thread.join(20.0)
    assert str(error.value) == f"zenoh:127.0.0.1:{port}: {error_here}"
    assert errors == [f"zenoh:127.0.0.1:{port}: {error_there}"]


@pytest.mark.parametrize(
    ("addresses", "why"),
    [
        (["zenoh:h:1", "zenoh:h:1"], "address zenoh:h:1 is listed twice"),
        (["ros:h:1/a", "ros:g:1/b"], "vehicles at several rosmasters"),
        (["zenoh:127.0.0.1:1", "zenoh:10.0.0.5:1"], "zenoh:10.0.0.5:1: learners beyond this machine need a shared key"),
    ],
)
def test_incompatible_addresses_are_refused(addresses, why):
    with pytest.raises(ConfigError, match=why):
        learn_for([Address.of(each) for each in addresses], threading.Event())


def pack_learner_state(preset):
    return pack_arrays({}, kind="learnt", about={"preset": dump(preset)})


def make_mission(folder, base, number=1, start=None, reference=None):
    (folder / "start").write_bytes(start or pack_learner_state(PRESETS["hover/retrim"]))
    capacities = dict.fromkeys((*OUTPUT_TOPICS, *INPUT_TOPICS), 10_000)
    return LearnerMission.of(number, reference, 0, base, ("residual", "policy"), 0, capacities, folder / "start").pack()


def test_new_flight_replaces_learners(tmp_path, monkeypatch):
    network, starts = InProcessBus(dict.fromkeys((*OUTPUT_TOPICS, *INPUT_TOPICS), 100_000)), []
    monkeypatch.setattr(Address, "join", lambda *_, **__: network)

    class RecordingServer(LearnerServer):
        def _start(self, layer):
            starts.append((self._mission.base, self._mission.number, layer))
            self.processes[layer] = launch("live_processes:nothing", None, tmp_path / "log")

    with RecordingServer(Address("zenoh", "127.0.0.1", 1)) as ground:
        network.publish("mission", b"noise")
        assert not ground._look()
        network.publish("mission", make_mission(tmp_path, "first"))
        assert ground._look()
        first = ground._bus.folder
        network.publish("mission", make_mission(tmp_path, "first", 2))  # another method of learning
        ground._look()
        assert starts == [("first", 1, "residual"), ("first", 1, "policy"), ("first", 2, "policy")]
        network.publish("mission", make_mission(tmp_path, "second"))
        ground._look()
        assert starts[3:] == [("second", 1, "residual"), ("second", 1, "policy")]
        assert not first.exists()
        network.publish("status", b"whatever")
        assert "compiling" in next(ground.learn())
        last = ground._bus.folder
    assert not last.exists()


def test_hung_learner_is_restarted(tmp_path, monkeypatch):
    network = InProcessBus(dict.fromkeys((*OUTPUT_TOPICS, *INPUT_TOPICS), 100_000))
    monkeypatch.setattr(Address, "join", lambda *_, **__: network)
    with DrillGround(Address("zenoh", "127.0.0.1", 1)) as ground:
        network.publish("mission", make_mission(tmp_path, "first"))
        assert ground._look()
        learner, until = ground.processes["policy"], time.monotonic() + 30.0
        while ground._bus.latest("beat.policy") is None and time.monotonic() < until:
            time.sleep(0.01)
        os.kill(learner.pid, signal.SIGSTOP)
        while not ground.restarts and time.monotonic() < until:
            ground._beat()
            time.sleep(0.1)
        assert ground.restarts == {"policy": 1}
        assert learner.poll() == -signal.SIGKILL
        assert ground.processes["policy"].poll() is None


@pytest.fixture
def bus_case(tmp_path, monkeypatch):
    """Return a network, and a ground station with idle learners."""
    network = InProcessBus(dict.fromkeys((*OUTPUT_TOPICS, *INPUT_TOPICS), 100_000))
    monkeypatch.setattr(Address, "join", lambda *_, **__: network)

    class IdleServer(LearnerServer):
        def _start(self, layer):
            self.processes[layer] = launch("live_processes:nothing", None, tmp_path / "log")

    with IdleServer(Address("zenoh", "127.0.0.1", 1), trust=("mine:trusted",)) as ground:
        yield network, ground


@pytest.mark.parametrize(
    ("changes", "reference", "why"),
    [
        ({"task": "os:abort"}, None, "names Python code, 'os:abort', which is not imported"),
        ({"vehicle": "os:abort"}, None, "pass --trust os:abort"),
        ({"adapt": {"residual": "os:abort"}}, None, "pass --trust os:abort"),
        ({"task": "track", "track": {"reference": "circle+os:abort"}}, None, "pass --trust os:abort"),
        ({}, "circle=3+os:abort", "pass --trust os:abort"),
        ({}, "/etc/passwd.csv", "names a file of this machine"),
        ({"vehicle": "quad.toml"}, None, "names a file of this machine"),
    ],
)
def test_mission_with_code_or_file_names_is_refused_and_reported(bus_case, tmp_path, changes, reference, why):
    network, ground = bus_case
    start = pack_learner_state(changed(PRESETS["hover/retrim"], **changes))
    network.publish("mission", make_mission(tmp_path, "first", start=start, reference=reference))
    assert why in next(ground.wait())
    assert not ground.processes
    text = last_note(network, "ground")
    assert text["base"] == "first"
    assert why in text["failed"]
    network.publish("mission", make_mission(tmp_path, "second", start=pack_learner_state(PRESETS["hover/retrim"])))
    assert list(ground.wait()) == []


def test_trusted_name_is_accepted(bus_case, tmp_path):
    network, ground = bus_case
    start = pack_learner_state(changed(PRESETS["hover/retrim"], adapt={"residual": "mine:trusted"}))
    network.publish("mission", make_mission(tmp_path, "first", start=start))
    assert list(ground.wait()) == []


def test_new_flight_gets_only_own_messages(bus_case, tmp_path):
    network, ground = bus_case
    network.publish("learning", b"before the flight")
    network.publish("mission", make_mission(tmp_path, "first"))
    steps = ground.learn()
    next(steps)
    assert ground._bus.latest("learning").data == b"before the flight"
    for topic in ("flight", "status", "parameters.reference"):
        network.publish(topic, b"of the first")
    next(steps)
    assert ground._bus.latest("flight").data == b"of the first"
    network.publish("learning", b"of the second")  # it may arrive before the ground reads the mission
    network.publish("mission", make_mission(tmp_path, "second"))
    next(steps)
    result = {topic: ground._bus.latest(topic) for topic in ("flight", "status", "parameters.reference")}
    assert result == dict.fromkeys(result)
    assert ground._bus.latest("learning").data == b"of the second"
    network.publish("flight", b"of the second")
    next(steps)
    assert ground._bus.latest("flight").data == b"of the second"


def test_ground_confirms_end_of_flight(bus_case, tmp_path):
    network, ground = bus_case
    network.publish("mission", make_mission(tmp_path, "first"))
    steps = ground.learn()
    next(steps)
    text = last_note(network, "ground")
    assert (text["base"], text["over"]) == ("first", False)
    network.publish("ended", pack_note("ended", reason="landed"))
    assert list(steps) == ["flight over: landed"]
    text = last_note(network, "ground")
    assert (text["base"], text["over"]) == ("first", True)


def test_failure_is_reported_at_once_and_raised_at_end(monkeypatch):
    monkeypatch.setattr(Address, "join", lambda *_, **__: InProcessBus({}))
    reported = threading.Event()

    class FakeServer(LearnerServer):
        def wait(self):
            return iter(())

        def learn(self):
            if self.address.key == "a":
                raise OSError("no room")
            until = time.monotonic() + 10.0
            while not reported.is_set() and time.monotonic() < until:
                yield "learnt: policy 7"

    def report(text):
        if text == "zenoh:127.0.0.1:1/a: failed: OSError('no room'); zenoh:127.0.0.1:1/b: learnt: policy 7":
            reported.set()

    monkeypatch.setattr(ground, "LearnerServer", FakeServer)
    with pytest.raises(OSError, match="no room"):
        learn_for([Address.of("zenoh:127.0.0.1:1/a"), Address.of("zenoh:127.0.0.1:1/b")], threading.Event(), report)
    assert reported.is_set()


def test_mission_survives_round_trip_and_damaged_bytes_are_refused(tmp_path):
    start = tmp_path / "start"
    start.write_bytes(np.random.default_rng(0).bytes(1000))
    capacities = {"flight": 1000, "parameters.policy": 5000, "knobs": 10}
    mission = LearnerMission.of(3, "circle", 7, "abc", ("residual", "policy"), 5, capacities, start)
    result = LearnerMission.unpack(mission.pack())
    assert result == mission
    assert result.capacities == {"flight": 1000, "parameters.policy": 5000}  # the bridge does not forward knobs
    rng, whole = np.random.default_rng(1), mission.pack()
    for _ in range(300):
        data = bytearray(whole)
        data[rng.integers(len(data))] ^= int(rng.integers(1, 256))
        with pytest.raises(MessageError):
            LearnerMission.unpack(bytes(data))
    for data in (b"", whole[:-1], rng.bytes(500)):
        with pytest.raises(MessageError):
            LearnerMission.unpack(data)


def test_bridge_forwards_each_topic_in_one_direction_at_limited_rate():
    now = 0.0
    topics = dict.fromkeys((*OUTPUT_TOPICS, *INPUT_TOPICS), 100)
    here, there = InProcessBus(topics), InProcessBus(topics | {"status": 1})
    bridge = Bridge(here, there, out=OUTPUT_TOPICS, into=INPUT_TOPICS, slowly=("flight",), clock=lambda: now)
    here.publish("flight", b"1")
    here.publish("parameters.policy", b"stays")
    there.publish("parameters.residual", b"comes")
    assert bridge.step() == 2
    assert there.latest("flight").data == b"1"
    assert here.latest("parameters.residual").data == b"comes"
    assert there.latest("parameters.policy") is None
    here.publish("flight", b"2")
    assert bridge.step() == 0
    here.publish("flight", b"3")
    now += LEAST_INTERVAL
    assert bridge.step() == 1
    assert there.latest("flight").data == b"3"
    here.publish("status", b"too long for there")
    assert bridge.step() == 0
    assert bridge.refusals == 1
