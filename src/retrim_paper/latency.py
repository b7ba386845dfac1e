"""Measures the latency of messages between two processes.

``python -m retrim_paper.latency`` runs the sending process.
"""

import os
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from retrim.onboard.launch import PYTHON
from retrim.transport.bus import Bus
from retrim.transport.remote import Address
from retrim.transport.shared_memory import SharedMemoryBus

SIZES = {"a measurement": 500, "the policy of hover/retrim": 74_000, "the policy of hover/paper": 1_100_000}
"""Size of each kind of message [bytes]."""
COUNT = 200  # number of messages of each size
PERIOD = 0.02  # [s], time between two messages
TOPICS = {"message": 2_000_000}
FIRST = 10  # number of messages at the start that do not count, since connections are still being made
DISCOVERY_TIME = 0.5  # [s], time in which both ends find each other
LONGEST, ANSWERS = 60.0, 20.0  # [s], time limits for all messages of a size, and for a rosmaster's answer


def measure_latencies(bus: Bus, words: Sequence[str], size: int) -> list[float]:
    """Return the message latencies [s], measured by the monotonic clock that both processes share.

    Args:
        bus: Receiving end of the bus.
        words: Command that starts the other process, without the size.
        size: Size of a message [bytes].
    """
    version = getattr(bus.latest("message"), "version", 0)
    writer = subprocess.Popen([*words, str(size)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    took: dict[int, float] = {}
    until = time.monotonic() + LONGEST
    while time.monotonic() < until and writer.poll() is None and FIRST + COUNT - 1 not in took:
        message = bus.latest("message", version)
        if message is None:
            time.sleep(5e-5)
            continue
        version, now = message.version, time.monotonic_ns()
        if len(message.data) == size:
            number, send_ns = (int.from_bytes(message.data[i : i + 8], "little") for i in (0, 8))
            took[number] = 1e-9 * (now - send_ns)
    writer.kill()
    writer.wait()
    return [seconds for number, seconds in took.items() if number >= FIRST]


def write(bus: Bus, size: int) -> None:
    """Send messages that contain their send times."""
    time.sleep(DISCOVERY_TIME)
    rest = bytes(size - 16)
    for number in range(FIRST + COUNT):
        time.sleep(PERIOD)
        stamp = number.to_bytes(8, "little") + time.monotonic_ns().to_bytes(8, "little")
        bus.publish("message", stamp + rest)
    time.sleep(DISCOVERY_TIME)


def free_port() -> int:
    """Return an unused port on the loopback address."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        return int(server.getsockname()[1])


@contextmanager
def rosmaster() -> Iterator[Address | None]:
    """Run a rosmaster; yield its address, or None if it is not installed."""
    if shutil.which("rosmaster") is None:
        yield None
        return
    address = Address("ros", "127.0.0.1", free_port())
    with TemporaryDirectory() as logs:
        environment = os.environ | {"ROS_LOG_DIR": logs, "PYTHONPATH": ""}
        words = ["rosmaster", "--core", "-p", str(address.port)]
        master = subprocess.Popen(words, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            until = time.monotonic() + ANSWERS
            while time.monotonic() < until:
                with socket.socket() as probe:
                    if probe.connect_ex(("127.0.0.1", address.port)) == 0:
                        break
                time.sleep(0.1)
            yield address
        finally:
            master.kill()
            master.wait()


@contextmanager
def two_machines() -> Iterator[tuple[str, Sequence[str]] | None]:
    """Create a second network namespace with a virtual cable to this one.

    Yield the address of this namespace and the words that run a command in the other one, or None without permission.
    """
    name, inside = f"retrim{os.getpid()}", ("ip", "netns", "exec", f"retrim{os.getpid()}")
    here, there = f"rt{os.getpid() % 10**6}a", f"rt{os.getpid() % 10**6}b"
    steps = (
        f"ip netns add {name}",
        f"ip link add {here} type veth peer name {there} netns {name}",
        f"ip addr add 10.213.7.1/24 dev {here}",
        f"ip link set {here} up",
        f"ip netns exec {name} ip addr add 10.213.7.2/24 dev {there}",
        f"ip netns exec {name} ip link set {there} up",
        f"ip netns exec {name} ip link set lo up",
    )
    is_available = shutil.which("ip") is not None and all(
        subprocess.run(step.split(), capture_output=True, check=False).returncode == 0 for step in steps
    )
    try:
        yield ("10.213.7.1", inside) if is_available else None
    finally:
        if shutil.which("ip") is not None:
            subprocess.run(["ip", "netns", "del", name], capture_output=True, check=False)


def other_process(where: str) -> list[str]:
    """Return the command for the other process, without the size; ``where`` is a folder or an address."""
    return [*PYTHON, "retrim_paper.latency", where]


def main() -> None:
    """Run the sending process."""
    where, size = sys.argv[1], int(sys.argv[2])
    bus = SharedMemoryBus(Path(where)) if "/" in where else Address.of(where).join(TOPICS, listen=False)
    try:
        write(bus, size)
    finally:
        bus.close()


if __name__ == "__main__":
    main()
