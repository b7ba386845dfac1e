"""Laws of every bus: the last message, whole, with a version that rises; a writer that dies leaves the last one."""

import multiprocessing
import os
import signal
import time

import pytest

from retrim.errors import MessageError
from retrim.transport.in_process import InProcessBus
from retrim.transport.shared_memory import SharedMemoryBus

TOPICS = {"a": 100, "big": 200_000}


@pytest.fixture(params=["in process", "shared memory"])
def bus(request):
    if request.param == "in process":
        yield InProcessBus(TOPICS)
    else:
        bus = SharedMemoryBus.create(TOPICS)
        yield bus
        bus.remove()


def test_the_last_message_counts(bus):
    assert bus.latest("a") is None
    for i in range(1, 6):
        bus.publish("a", b"message %d" % i)
        assert bus.latest("a") == (i, b"message %d" % i)
    assert bus.latest("a", after=4) == (5, b"message 5")
    assert bus.latest("a", after=5) is None
    assert bus.latest("big") is None


def test_messages_of_any_length(bus):
    for n in (0, 1, 99, 100):
        bus.publish("a", bytes(range(n)))
        assert bus.latest("a").data == bytes(range(n))
    with pytest.raises(MessageError, match="'a': a message of 101 bytes, room for 100"):
        bus.publish("a", bytes(101))
    assert bus.latest("a").data == bytes(range(100))


def test_a_topic_that_there_is_not(bus):
    for call in (lambda: bus.publish("b", b""), lambda: bus.latest("b")):
        with pytest.raises(MessageError, match="no topic 'b' on this bus; there are a, big"):
            call()


def test_one_who_joins_late_has_the_last_message():
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
    with pytest.raises(MessageError, match="no bus there"):
        SharedMemoryBus(bus.folder)


def _write_for_ever(folder):
    bus = SharedMemoryBus(folder)
    i = 0
    while True:
        i += 1
        bus.publish("big", (i % 256).to_bytes(1, "little") * (1 + 7919 * i % TOPICS["big"]))


def test_readers_never_see_half_a_message_and_a_killed_writer_leaves_a_whole_one():
    bus = SharedMemoryBus.create(TOPICS)
    try:
        for _ in range(3):
            writer = multiprocessing.get_context("spawn").Process(
                target=_write_for_ever, args=(bus.folder,), daemon=True
            )
            writer.start()
            seen, version, until = 0, 0, time.monotonic() + 20.0
            while seen < 200 and time.monotonic() < until:
                if (found := bus.latest("big", after=version)) is not None:
                    version, seen = found.version, seen + 1
                    assert len(set(found.data)) == 1
            os.kill(writer.pid, signal.SIGKILL)
            writer.join()
            assert seen == 200
            assert len(set(bus.latest("big").data)) == 1
    finally:
        bus.remove()
