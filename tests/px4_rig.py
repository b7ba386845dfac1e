"""PX4's simulation, and changes of its parameters in flight."""

import os
import time
from pathlib import Path

from retrim.onboard.recorder import read_log
from retrim.plants.bridges.endpoint import UdpEndpoint
from retrim.plants.bridges.mavlink_link import MavlinkLink
from retrim.testing.px4 import PAYLOAD

PX4 = os.environ.get("RETRIM_PX4", "")
SIH = str(Path(__file__).parents[1] / "examples/px4_sih.toml")
ADDRESS = "mavlink:udp:127.0.0.1:14540"


class Changes:
    """Sets parameters of PX4 in flight, by a link of its own."""

    def __init__(self):
        self.link = MavlinkLink(UdpEndpoint("127.0.0.1", PAYLOAD))

    def set_at(self, log, when, flight, **parameters):
        """Wait for a time of the flight [s], and set them."""
        while flight.poll() is None and not (log.exists() and len(rows := read_log(log)) and rows[-1, 1] >= when):
            self.link.pump(time.monotonic() + 0.1)
        for name, value in parameters.items():
            for _ in range(3):
                self.link.set_parameter(name, value)
                self.link.pump(time.monotonic() + 0.02)
