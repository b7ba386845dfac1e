"""Measures the message latency on each bus."""

from collections.abc import Sequence
from contextlib import closing
from importlib.util import find_spec
from typing import Any

import numpy as np

from retrim.runkit.document import Document, TableSection
from retrim.runkit.reporter import Reporter
from retrim.runkit.run import Run
from retrim.transport.bus import Bus
from retrim.transport.remote import Address
from retrim.transport.shared_memory import SharedMemoryBus

from ..latency import COUNT, PERIOD, SIZES, TOPICS, free_port, measure_latencies, other_process, rosmaster, two_machines

INTRO = (
    "Made by `retrim reproduce buses`. One way, from the call in one process to the bytes in another, by the clock "
    f"that both share; {COUNT} messages of each size, one every {1e3 * PERIOD:g} ms. Between namespaces: two network "
    "namespaces of this machine with a virtual cable. ROS 1 with a real rosmaster, rospy at both ends. What is not "
    "installed, or not allowed, is left out."
)
COLUMNS = ("bus", "message", "p50 [ms]", "p99 [ms]", "max [ms]", "arrived")


def buses(run: Run, reporter: Reporter) -> None:
    """Message latency over shared memory, zenoh (also between two network namespaces) and ROS 1.

    Args:
        run: Folder for buses.md and buses.json.
        reporter: Receives progress and the table.
    """
    rows: list[dict[str, Any]] = []
    bus = SharedMemoryBus.create(TOPICS)
    try:
        rows += _time_bus("shared memory", bus, other_process(str(bus.folder)), run, reporter)
    finally:
        bus.remove()
    if find_spec("zenoh") is not None:
        rows += _network("zenoh", Address("zenoh", "127.0.0.1", free_port()), (), run, reporter)
        with two_machines() as machines:
            if machines is not None:
                host, inside = machines
                rows += _network("zenoh, between namespaces", Address("zenoh", host, 7447), inside, run, reporter)
    with rosmaster() as master:
        if master is not None:
            rows += _network("ROS 1", master, (), run, reporter)
    lines = tuple(
        (
            row["bus"],
            f"{row['message']}, {row['bytes'] / 1000:g} kB",
            *(f"{row[q]:.2f}" for q in ("p50_ms", "p99_ms", "max_ms")),
            f"{row['n']} of {COUNT}",
        )
        for row in rows
    )
    document = Document(run, "buses", "Latency of the buses", INTRO, [], reporter)
    document.add(TableSection(COLUMNS, lines), rows)


def _network(name: str, address: Address, inside: Sequence[str], run: Run, reporter: Reporter) -> list[dict[str, Any]]:
    where = f"{address.kind}:{address.host}:{address.port}"
    with closing(address.join(TOPICS, listen=True)) as bus:
        return _time_bus(name, bus, [*inside, *other_process(where)], run, reporter)


def _time_bus(name: str, bus: Bus, words: Sequence[str], run: Run, reporter: Reporter) -> list[dict[str, Any]]:
    rows = []
    with reporter.progress(name) as advance:
        for i, (message, size) in enumerate(SIZES.items()):
            if run.interrupted:
                break
            advance(i / len(SIZES), message)
            took = 1e3 * np.array(measure_latencies(bus, words, size))
            if len(took):
                p50, p99 = np.percentile(took, (50, 99))
                quantiles = {"p50_ms": float(p50), "p99_ms": float(p99), "max_ms": float(took.max())}
                rows.append({"bus": name, "message": message, "bytes": size, "n": len(took)} | quantiles)
    return rows
