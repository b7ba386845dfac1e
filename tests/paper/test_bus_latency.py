"""Processes that measure the latency of buses: their messages, addresses, and cleanup."""

import itertools
import os
import socket
import subprocess
import sys
import time

import pytest

from retrim.transport.bus import Bus
from retrim_paper import latency

MASTER = """#!{python}
import socket, sys, time
time.sleep(0.3)
assert sys.argv[1] == "--core"
server = socket.create_server(("127.0.0.1", int(sys.argv[sys.argv.index("-p") + 1])))
time.sleep(60)
"""


class RecordingBus(Bus):
    """A bus that records published messages and their times."""

    closed = False

    def __init__(self):
        self.messages = []

    def publish(self, topic, data):
        self.messages.append((topic, data, time.monotonic_ns()))

    def latest(self, topic, after=0):
        return None

    def close(self):
        self.closed = True


@pytest.fixture
def quick(monkeypatch):
    for name, value in (("COUNT", 3), ("FIRST", 2), ("PERIOD", 0.01), ("DISCOVERY_TIME", 0.05)):
        monkeypatch.setattr(latency, name, value)


def test_messages_contain_number_and_time(quick):
    bus = RecordingBus()
    began = time.monotonic_ns()
    latency.write(bus, 100)
    assert [topic for topic, *_ in bus.messages] == ["message"] * 5  # including messages that do not count
    assert {len(data) for _, data, _ in bus.messages} == {100}
    assert [int.from_bytes(data[:8], "little") for _, data, _ in bus.messages] == [0, 1, 2, 3, 4]
    stamps = [int.from_bytes(data[8:16], "little") for _, data, _ in bus.messages]
    assert stamps[0] - began > 0.05e9  # both ends connect first
    for stamp, (*_, sending) in zip(stamps, bus.messages, strict=True):
        assert 0 <= sending - stamp < 0.5e9
    assert all(b - a > 0.009e9 for a, b in itertools.pairwise(stamps))


@pytest.mark.parametrize("where", ["folder/of/a/bus", "zenoh:127.0.0.1:7447"])
def test_other_process_joins_and_leaves_given_bus(where, monkeypatch):
    bus, calls = RecordingBus(), []

    class Address:
        @staticmethod
        def of(text):
            calls.append(text)
            return Address()

        def join(self, topics, *, listen):
            calls.append((topics, listen))
            return bus

    def folder(path):
        calls.append(str(path))
        return bus

    def write(one, size):
        assert one is bus
        calls.append(size)
        raise RuntimeError("cut")

    monkeypatch.setattr(latency, "Address", Address)
    monkeypatch.setattr(latency, "SharedMemoryBus", folder)
    monkeypatch.setattr(latency, "write", write)
    monkeypatch.setattr(sys, "argv", ["latency", where, "500"])
    with pytest.raises(RuntimeError, match="cut"):
        latency.main()
    assert bus.closed
    assert calls == ([where, 500] if "/" in where else [where, (latency.TOPICS, False), 500])


def test_rosmaster_is_ready_before_use_and_ends_afterwards(tmp_path, monkeypatch):
    program = tmp_path / "rosmaster"
    program.write_text(MASTER.format(python=sys.executable))
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    with latency.rosmaster() as address:
        assert (address.kind, address.host) == ("ros", "127.0.0.1")
        socket.create_connection(("127.0.0.1", address.port), 1.0).close()
    with pytest.raises(OSError, match="refused"):
        socket.create_connection(("127.0.0.1", address.port), 1.0)
    program.unlink()
    with latency.rosmaster() as nobody:
        assert nobody is None


@pytest.mark.parametrize("allowance", [True, False])
def test_two_machines_are_connected_namespaces_and_removed(allowance, monkeypatch):
    process = []

    def run(words, **_):
        process.append(" ".join(words))
        return subprocess.CompletedProcess(words, 0 if allowance else 1)

    monkeypatch.setattr(latency.shutil, "which", lambda name: f"/sbin/{name}")
    monkeypatch.setattr(latency.subprocess, "run", run)
    name = f"retrim{os.getpid()}"
    with latency.two_machines() as machines:
        if not allowance:
            assert machines is None
            assert len(process) == 1  # the remaining commands are not tried
        else:
            host, inside = machines
            assert " ".join(inside) == f"ip netns exec {name}"
            assert any(words.startswith(f"ip addr add {host}/24 dev ") for words in process)
            there = [words for words in process if words.startswith(f"ip netns exec {name} ip link set")]
            assert len(there) == 2  # the end of the cable, and the loopback of the namespace
    assert process[-1] == f"ip netns del {name}"
    monkeypatch.setattr(latency.shutil, "which", lambda name: None)
    process.clear()
    with latency.two_machines() as machines:
        assert machines is None
    assert process == []
