"""Laws of every bus: readers get the last complete message with an increasing version, even if its writer has died."""

import multiprocessing
import os
import signal
import socket
import time
from contextlib import ExitStack
from types import SimpleNamespace

import pytest

from bus_ends import LOCAL, NETWORK, await_message, network_address, two_ends
from live_processes import answer, write_for_ever
from retrim.errors import ConfigError, MessageError
from retrim.onboard.topics import INPUT_TOPICS, OUTPUT_TOPICS
from retrim.ros1 import bus as ros
from retrim.ros2.node import check_topic
from retrim.transport.network import NetworkBus
from retrim.transport.remote import Address
from retrim.transport.ros2 import name_of
from retrim.transport.session import GREETINGS
from retrim.transport.shared_memory import SharedMemoryBus
from retrim_paper.latency import free_port

TOPICS = {"a": 100, "b.c": 100, "there": 100, "back": 100, "nothing": 100, "again": 100, "big": 200_000}


@pytest.fixture(scope="module", params=[*LOCAL, *NETWORK])
def ends(request):
    """Return one pair of ends for all tests; each test has separate topics, or continues those of an earlier test."""
    yield from two_ends(request.param, TOPICS)


def test_last_message_is_received(ends):
    writer, reader = ends
    version = 0
    for i in range(1, 6):
        writer.publish("a", b"message %d" % i)
        result = await_message(reader, "a", version, b"message %d" % i)
        assert result.version > version
        version = result.version
        assert reader.latest("a", after=version) is None
    assert reader.latest("a", after=version - 1) == (version, b"message 5")
    assert reader.latest("nothing") is None


def test_messages_of_any_length(ends):
    writer, reader = ends
    for n in (0, 1, 99, 100):
        writer.publish("b.c", bytes(range(n)))
        assert await_message(reader, "b.c", data=bytes(range(n)))
    with pytest.raises(MessageError, match=r"'b\.c': a message of 101 bytes exceeds the capacity of 100"):
        writer.publish("b.c", bytes(101))
    assert reader.latest("b.c").data == bytes(range(100))
    writer.publish("big", bytes(200_000))
    assert len(await_message(reader, "big").data) == 200_000


def test_unknown_topic_is_refused(ends):
    for call in (lambda: ends.writer.publish("b", b""), lambda: ends.reader.latest("b")):
        with pytest.raises(MessageError, match=r"no topic 'b' on this bus; there are a, again, b\.c, back"):
            call()


def test_each_end_writes_its_own_topic(ends):
    ends.writer.publish("there", b"there")
    ends.reader.publish("back", b"back")
    await_message(ends.reader, "there", data=b"there")
    await_message(ends.writer, "back", data=b"back")


@pytest.mark.parametrize("backend", NETWORK)
def test_late_process_receives_last_message_and_continues_version(backend):
    where = network_address(backend)
    bus = where.join(TOPICS, listen=True)
    bus.publish("again", b"before")
    version = bus.latest("again").version
    words = where, TOPICS, "again", b"of another process"
    other = multiprocessing.get_context("spawn").Process(target=answer, args=words, daemon=True)
    other.start()
    try:
        assert await_message(bus, "again", version, b"of another process", patience=30.0).version > version
    finally:
        other.kill()
        other.join(10.0)
        bus.close()


def test_only_newer_messages_that_fit_are_accepted():
    class LoopBus(NetworkBus):
        def _send(self, topic, frame):
            self.frame = frame

        def close(self):
            pass

    bus, other = LoopBus(TOPICS), LoopBus(TOPICS)
    other.publish("a", b"one")
    first = other.frame
    other.publish("a", b"two")
    bus._receive("a", other.frame)
    bus._receive("a", first)  # overtaken
    bus._receive("a", b"short")
    bus._receive("a", bytes(1000))
    assert bus.latest("a") == (2, b"two")
    assert bus.refusals == 2
    again = LoopBus(TOPICS)
    again.publish("a", b"started again")
    bus._receive("a", again.frame)
    assert bus.latest("a") == (3, b"started again")
    bus.publish("a", b"mine")
    bus._receive("a", bus.frame)  # an echo
    assert bus.latest("a") == (4, b"mine")


@pytest.mark.parametrize("text", ["", "zenoh", "zenoh:", "zenoh::7447", "zenoh:host:0", "zenoh:host:99999",
                                  "tcp:host:1", "ros:host:port", "zenoh:host:1/", "ros:host:1/a b", "ros2", "ros2:",
                                  "ros2:233", "ros2:host:1", "ros2:1/"])  # fmt: skip
def test_invalid_address_is_refused(text):
    with pytest.raises(ConfigError, match="is not an address of a bus; expected zenoh:HOST:PORT, ros2:DOMAIN or ros:"):
        Address.of(text)


@pytest.mark.parametrize("text", ["zenoh:10.0.0.5:7447", "ros:robot:11311/quad1", "ros2:42", "ros2:0/quad1"])
def test_address_survives_round_trip(text):
    assert str(Address.of(text)) == text


def test_vehicles_with_different_keys_are_separate():
    """Each vehicle has a key; an end with a different key, or with none, receives nothing from it."""
    pytest.importorskip("zenoh")
    port = free_port()
    with ExitStack() as stack:

        def end(key, *, listen=False):
            bus = Address("zenoh", "127.0.0.1", port, key).join(TOPICS, listen=listen)
            stack.callback(bus.close)
            return bus

        one, same, other, none = end("quad1", listen=True), end("quad1"), end("quad2"), end("")
        one.publish("a", b"one")
        until = time.monotonic() + 10.0
        while same.latest("a") is None and time.monotonic() < until:
            time.sleep(0.02)
        assert same.latest("a").data == b"one"
        time.sleep(0.2)
        assert other.latest("a") is None
        assert none.latest("a") is None


def test_ros_topics_have_subscribers_before_first_message(monkeypatch):
    declaration, sending = [], []

    class Rospy:
        def Subscriber(self, *_, **__):
            pass

        def Publisher(self, name, *_, latch, **__):
            assert latch
            declaration.append(name)
            return SimpleNamespace(publish=lambda data: sending.append((name, data[-4:])))

    monkeypatch.setattr(ros, "join", lambda master: Rospy())
    monkeypatch.setattr(ros, "system_module", lambda name: SimpleNamespace(UInt8MultiArray=None))
    bus = Address("ros", "h", 1, "quad1").join(TOPICS, listen=True, writes=("a", "b.c"))
    assert declaration == ["/retrim/quad1/a", "/retrim/quad1/b/c", "/retrim/quad1/greeting/flight"]
    bus.publish("a", b"last")
    assert len(declaration) == 3
    bus.publish("there", b"also")
    assert declaration[3:] == ["/retrim/quad1/there"]
    assert sending[1:] == [("/retrim/quad1/a", b"last"), ("/retrim/quad1/there", b"also")]


def test_every_bridge_topic_has_a_ros_2_name():
    names = [name_of(topic) for topic in (*OUTPUT_TOPICS, *INPUT_TOPICS, *GREETINGS)]
    for name in names:
        check_topic(f"/retrim/quad1/{name}")
    assert len(set(names)) == len(names)


@pytest.mark.parametrize("place", ["127.0.0.1:1", "..:1"])
def test_missing_master_is_reported(place):
    with pytest.raises(ConfigError, match=f"ROS: no rosmaster at 'http://{place}'"):
        Address.of(f"ros:{place}").join(TOPICS, listen=True)


def test_address_in_use_is_reported():
    pytest.importorskip("zenoh")
    with socket.create_server(("127.0.0.1", 0)) as server:
        where = Address("zenoh", "127.0.0.1", server.getsockname()[1])
        with pytest.raises(ConfigError, match=f"zenoh: cannot join at 'tcp/127.0.0.1:{where.port}'"):
            where.join(TOPICS, listen=True)


def test_late_reader_receives_last_message():
    bus = SharedMemoryBus.create(TOPICS)
    try:
        bus.publish("a", b"before")
        late = SharedMemoryBus(bus.folder)
        assert late.latest("a") == (1, b"before")
        late.publish("a", b"a writer that was started again goes on counting")
        assert bus.latest("a").version == 2
        late.close()
        assert oct(bus.folder.stat().st_mode)[-3:] == "700"
    finally:
        bus.remove()
    assert not bus.folder.exists()
    with pytest.raises(MessageError, match="there is no bus"):
        SharedMemoryBus(bus.folder)


def is_whole(data):
    return data.count(data[:1]) == len(data) > 0


def test_messages_are_complete_even_if_writer_is_killed():
    bus = SharedMemoryBus.create(TOPICS)
    try:
        for _ in range(3):
            words = bus.folder, "big", TOPICS["big"]
            writer = multiprocessing.get_context("spawn").Process(target=write_for_ever, args=words, daemon=True)
            writer.start()
            observation, version, until = 0, 0, time.monotonic() + 20.0
            while observation < 200 and time.monotonic() < until:
                if (result := bus.latest("big", after=version)) is not None:
                    version, observation = result.version, observation + 1
                    assert is_whole(result.data)
            os.kill(writer.pid, signal.SIGKILL)
            writer.join()
            assert observation == 200
            assert is_whole(bus.latest("big").data)
    finally:
        bus.remove()
