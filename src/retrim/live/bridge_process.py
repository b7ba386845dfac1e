"""The process that carries topics between a flight and its learners on another machine."""

import time
from dataclasses import dataclass
from pathlib import Path

from ..onboard.messages import pack_note
from ..onboard.realtime import Lifeline
from ..onboard.topics import INTO, MOST, OUT, SLOWLY
from ..transport.bridge import Bridge
from ..transport.remote import Address
from ..transport.shared_memory import SharedMemoryBus

IDLE = 0.002  # [s]


@dataclass(frozen=True)
class BridgePlan:
    """Everything that the process is started with."""

    folder: Path
    """Of the bus of the flight."""
    address: Address
    parent: int


def carry(plan: BridgePlan) -> None:
    """Carry until somebody ends the process: its main function."""
    bus, parent = SharedMemoryBus(plan.folder), Lifeline(plan.parent)
    network = plan.address.join(dict.fromkeys((*OUT, *INTO), MOST), listen=True)
    try:
        bridge = Bridge(bus, network, out=OUT, into=INTO, slowly=SLOWLY)
        bus.publish("ready.bridge", pack_note("ready"))
        while not parent.gone():
            if not bridge.step():
                time.sleep(IDLE)
    finally:
        network.close()  # its threads would keep the process alive
