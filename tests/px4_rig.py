"""PX4's simulation, and changes of its parameters in flight."""

import os
import struct
import time
from pathlib import Path

from retrim.onboard.recorder import read_log
from retrim.plants.bridges.endpoint import UdpEndpoint
from retrim.plants.bridges.mavlink_link import MavlinkLink
from retrim.testing.px4 import PAYLOAD

PX4 = os.environ.get("RETRIM_PX4", "")
EXAMPLES = Path(__file__).parents[1] / "examples"
SIH, X500 = str(EXAMPLES / "px4_sih.toml"), str(EXAMPLES / "x500.toml")
ADDRESS = "mavlink:udp:127.0.0.1:14540"
INT32, REAL32 = 6, 9  # MAV_PARAM_TYPE


def wait_until(log, when, flight):
    """Wait until a live flight has written a time to its log [s], or until it is over."""
    while flight.poll() is None and not (log.exists() and len(rows := read_log(log)) and rows[-1, 1] >= when):
        time.sleep(0.1)


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
                self._set(name, value)
                self.link.pump(time.monotonic() + 0.02)

    def _set(self, name, value):
        """Send PARAM_SET; an integer is sent as its bit pattern, following the PX4 convention."""
        if self.link.system is not None:
            real = struct.unpack("<f", struct.pack("<i", value))[0] if isinstance(value, int) else value
            kind = INT32 if isinstance(value, int) else REAL32
            self.link._send(self.link._sender.param_set_encode(*self.link.system, name.encode(), real, kind))
