"""PX4 over MAVLink as a plant: it takes off by itself, hands over control, and lands when the flight is over."""

import time

import numpy as np

from ...errors import PlantError
from ..entry import PlantEntry
from ..extras import check_extra
from .endpoint import address_of, open_endpoint
from .mavlink_link import MavlinkLink
from .offboard_plant import OffboardPlant
from .polling import KeepOn

ADDRESS = "udp:127.0.0.1:14540"  # that PX4 sends to on its own machine
PX4 = 12  # MAV_AUTOPILOT
STREAMS = {"ODOMETRY": 100.0, "ATTITUDE_TARGET": 25.0, "HIL_STATE_QUATERNION": 50.0}  # [Hz]
UNUSED_MESSAGES = ("HIGHRES_IMU", "ATTITUDE", "ALTITUDE", "VFR_HUD", "SERVO_OUTPUT_RAW", "HIL_ACTUATOR_CONTROLS")
# [s], limits for the first message and for readiness; time after which arming is tried even if PX4 is not ready
ANSWER_S, READY_S, UNREADY_S = 10.0, 40.0, 12.0


class MavlinkPlant(OffboardPlant[MavlinkLink]):
    """A PX4 vehicle at a UDP port or on a serial line."""

    def __init__(self, address: str, dt: float, low: np.ndarray, high: np.ndarray) -> None:
        """Build a plant; it opens the port when it connects.

        Args:
            address: ``udp:HOST:PORT`` that PX4 sends to, or ``serial:DEVICE:BAUD``.
            dt: Control period [s].
            low: Smallest command [c, omega].
            high: Largest command [c, omega].

        Raises:
            ConfigError: The address is invalid, or the control period is outside the range that PX4 supports.
        """
        super().__init__(address or ADDRESS, dt, low, high)
        address_of(self.address)

    def connect(self, keep_on: KeepOn = lambda: True) -> None:
        """Connect to PX4, and wait until it can be armed."""
        if self._link is None:
            endpoint = open_endpoint(self.address)
            try:
                self._link = MavlinkLink(endpoint, datagrams=self.address.startswith("udp"))
            except BaseException:
                endpoint.close()
                raise
        link = self._link
        if not self.until(lambda: link.system is not None, ANSWER_S, keep_on):
            raise PlantError(
                f"{self.address}: no autopilot was heard there in {ANSWER_S:g} s; "
                "is it on, and does it send to this address?"
            )
        if link.autopilot != PX4:
            raise PlantError(f"{self.address}: autopilot {link.autopilot} responds; only PX4 ({PX4}) is supported")
        for message, rate in STREAMS.items():
            link.stream(message, max(rate, 2.0 / self.dt) if message == "ODOMETRY" else rate)
        for message in UNUSED_MESSAGES:
            link.stream(message, 1.0)
        began = time.monotonic()
        # With motion capture instead of GPS, PX4 does not report that it can be armed, although it can.
        is_ready = lambda: link.reading is not None and (link.ready or time.monotonic() - began > UNREADY_S)  # noqa: E731
        if not self.until(is_ready, READY_S, keep_on):
            raise PlantError(f"{self.address}: no position in {READY_S:g} s{self._status_text()}")


entry = PlantEntry(
    lambda request: MavlinkPlant(request.address, request.dt, *request.limits),
    "a vehicle, or a simulation, that PX4 flies",
    is_vehicle=True,
    check_address=lambda address: address_of(address or ADDRESS),
    needs=lambda: check_extra("pymavlink", "mavlink", package="pymavlink"),
)
