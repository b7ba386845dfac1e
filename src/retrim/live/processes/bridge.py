"""Process that transfers topics between a flight and its learners on another machine."""

import signal
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from types import FrameType

from ...onboard.heartbeat import Pacemaker
from ...onboard.messages import pack_note
from ...onboard.realtime import ParentWatch
from ...onboard.topics import INPUT_TOPICS, NETWORK_SIZES, OUTPUT_TOPICS, SLOW_TOPICS
from ...transport.bridge import Bridge
from ...transport.bus import Bus
from ...transport.remote import Address
from ...transport.shared_memory import SharedMemoryBus
from ..refused_notes import NETWORK

IDLE = 0.002  # [s]
SILENCE = 10.0  # [s] without a measurement, after which a flight without a supervisor is over; its autopilot may land
PATIENCE = 10.0  # [s], longest time that the network may block the bridge
LINGER = 2.0  # [s] after the end of the flight, during which the note about the end reaches the learners


@dataclass(frozen=True)
class BridgePlan:
    """Arguments of the process."""

    folder: Path
    """Folder of the flight's bus."""
    address: Address
    parent: int


def carry(plan: BridgePlan) -> None:
    """Transfer messages until the process is terminated; this is the main function of the process.

    Without a supervisor, the function returns when the flight is over.
    """
    signal.signal(signal.SIGTERM, _stop_on_signal)  # close the network properly in this case, too
    bus, parent = SharedMemoryBus(plan.folder), ParentWatch(plan.parent)
    network = plan.address.join(NETWORK_SIZES, listen=True, writes=OUTPUT_TOPICS)
    try:
        bridge = Bridge(bus, network, out=OUTPUT_TOPICS, into=INPUT_TOPICS, slowly=SLOW_TOPICS)
        bus.publish("ready.bridge", pack_note("ready"))
        versions, since, refusals = (0, 0), time.monotonic(), (0, "")
        with Pacemaker(bus, "bridge") as heart:
            # A vehicle without a supervisor still lands, and the learners wait for the note about the end.
            while not (parent.has_ended() and time.monotonic() > since + (LINGER if versions[1] else SILENCE)):
                heart.touch(PATIENCE)
                if not bridge.step():
                    time.sleep(IDLE)
                refusals = _publish_refusals(bus, network, refusals)
                if (now := _newest_versions(bus)) != versions:
                    versions, since = now, time.monotonic()
    finally:
        network.close()  # otherwise the threads of the network would keep the process alive


def _publish_refusals(bus: Bus, network: Bus, before: tuple[int, str]) -> tuple[int, str]:
    """Publish any change in the number of refused messages or in the fault that prevents their reception."""
    now = network.refusals, network.fault
    if now != before:
        bus.publish(NETWORK, pack_note(NETWORK, count=now[0], last=now[1] or "a message that was none, forged or old",
                                       fault=now[1]))  # fmt: skip
    return now


def _newest_versions(bus: Bus) -> tuple[int, int]:
    """Return the versions of the newest measurement and of the note about the end of the flight."""
    sample, end_note = bus.latest("sample"), bus.latest("ended")
    return 0 if sample is None else sample.version, 0 if end_note is None else end_note.version


def _stop_on_signal(number: int, frame: FrameType | None) -> None:
    sys.exit(128 + number)
