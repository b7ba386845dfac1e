"""Two ends of a bus of each kind, for tests of all buses."""

import atexit
import functools
import os
import time
from contextlib import ExitStack
from typing import NamedTuple

import pytest

from retrim.transport.bus import Bus
from retrim.transport.in_process import InProcessBus
from retrim.transport.remote import Address
from retrim.transport.shared_key import SharedKey
from retrim.transport.shared_memory import SharedMemoryBus
from retrim_paper.latency import free_port, rosmaster

LOCAL, NETWORK = ("in process", "shared memory"), ("zenoh", "zenoh, signed", "ros2, signed", "ros")


class Ends(NamedTuple):
    """Two ends of one bus."""

    writer: Bus
    reader: Bus


@functools.cache
def master():
    """Start a real rosmaster, one per process, since rospy supports only one; skip the test without an installation."""
    stack = ExitStack()
    atexit.register(stack.close)
    address = stack.enter_context(rosmaster())
    if address is None:
        pytest.skip("needs rosmaster and rospy: make test-ros installs them")
    return address


def two_ends(backend, topics):
    """Yield two ends of a new bus."""
    if backend == "in process":
        bus = InProcessBus(topics)
        yield Ends(bus, bus)
        return
    if backend == "shared memory":
        bus = SharedMemoryBus.create(topics)
        result = Ends(bus, SharedMemoryBus(bus.folder))
    else:
        address = network_address(backend)
        result = Ends(address.join(topics, listen=True), address.join(topics, listen=False))
    yield result
    result.reader.close()
    result.writer.remove() if backend == "shared memory" else result.writer.close()


def network_address(backend):
    """Return the address of a new bus on a network."""
    if backend == "ros":
        return master()
    shared = SharedKey(bytes(32)) if backend.endswith("signed") else None
    if backend.startswith("ros2"):
        pytest.importorskip("cyclonedds")
        os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
        return Address("ros2", "", 100 + os.getpid() % 100, f"bus{free_port()}", shared=shared)
    pytest.importorskip("zenoh")
    return Address("zenoh", "127.0.0.1", free_port(), shared=shared)


def await_message(bus, topic, after=0, data=None, patience=10.0):
    """Return the message of a topic as soon as it arrives."""
    until = time.monotonic() + patience
    while time.monotonic() < until:
        result = bus.latest(topic, after)
        if result is not None and data in (None, result.data):
            return result
        time.sleep(1e-3)
    raise AssertionError(f"no message on {topic!r} within {patience} s")
