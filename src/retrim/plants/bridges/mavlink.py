"""PX4 over MAVLink as a plant: it takes off by itself, hands over control, and lands when the flight is over."""

import math
import time
from collections.abc import Sequence

import numpy as np

from ...errors import ConfigError, PlantError
from ..entry import PlantEntry
from ..extras import check_extra
from .endpoint import address_of, open_endpoint
from .frames import heading_of
from .linked_plant import LinkedPlant, ThrustScale
from .mavlink_link import MavlinkLink
from .polling import KeepOn, insisting, wait_until
from .vehicle_state import VehicleState

ADDRESS = "udp:127.0.0.1:14540"  # that PX4 sends to on its own machine
PX4 = 12  # MAV_AUTOPILOT
OFFBOARD, LAND = (6, 0), (4, 6)  # main and sub mode
SET_MODE, ARM_DISARM = 176, 400  # MAV_CMD
STREAMS = {"ODOMETRY": 100.0, "ATTITUDE_TARGET": 25.0, "HIL_STATE_QUATERNION": 50.0}  # [Hz]
UNUSED = ("HIGHRES_IMU", "ATTITUDE", "ALTITUDE", "VFR_HUD", "SERVO_OUTPUT_RAW", "HIL_ACTUATOR_CONTROLS")
# [s], limits for the first message and for readiness; time after which arming is tried even if PX4 is not ready
LISTENS_S, READY_S, UNREADY_S = 10.0, 40.0, 12.0
SWITCH_S, ARM_S, GO_S, LANDING_S = 5.0, 8.0, 40.0, 40.0  # [s]
ASK_AGAIN_S = 1.0  # [s]
LOST_S = 2.0  # [s] of silence, after which the autopilot's failsafe has long taken over
THRUST_S = 2.0  # [s] over which the thrust at hover is identified
TELL_EVERY_S = 0.05  # [s] between two position setpoints


class MavlinkPlant(LinkedPlant[MavlinkLink]):
    """A PX4 vehicle that receives thrust and body rates in offboard mode.

    The world frame is east, north, up from the origin of the autopilot's local frame. Thrust per mass is the share of
    the motors' thrust times g, divided by the share at hover. The share at hover is identified while the autopilot
    hovers before the hand-over. Adaptation compensates for a non-linear thrust map (``THR_MDL_FAC``), a sagging battery
    or a different load.
    """

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
        if not 0.004 <= dt <= 0.1:
            raise ConfigError(f"dt = {dt} s: PX4 is commanded at 10 to 250 Hz")
        address_of(self.address)
        self.thrust = ThrustScale(0.0, 1.0)
        """Scale of thrust commands; its range is the motors' full thrust."""
        self._is_engaged = False
        self._place, self._heading, self._last_note = np.zeros(3), 0.0, -math.inf

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
        if not self.until(lambda: link.system is not None, LISTENS_S, keep_on):
            raise PlantError(
                f"{self.address}: no autopilot was heard there in {LISTENS_S:g} s; is it on, and does it send there?"
            )
        if link.autopilot != PX4:
            raise PlantError(f"{self.address}: autopilot {link.autopilot} answers; only PX4 ({PX4}) is known")
        for message, rate in STREAMS.items():
            link.stream(message, max(rate, 2.0 / self.dt) if message == "ODOMETRY" else rate)
        for message in UNUSED:
            link.stream(message, 1.0)
        began = time.monotonic()
        # With motion capture instead of GPS, PX4 does not report that it can be armed, although it can.
        is_ready = lambda: link.reading is not None and (link.ready or time.monotonic() - began > UNREADY_S)  # noqa: E731
        if not self.until(is_ready, READY_S, keep_on):
            raise PlantError(f"{self.address}: no position in {READY_S:g} s{self._status_text()}")

    def take_off(self, p: np.ndarray | None, yaw: float | None, keep_on: KeepOn = lambda: True) -> None:
        """Let PX4 fly to a position, and identify PX4's thrust command at hover."""
        x, link = self.reading(), self.link
        up = np.array([0.0, 0.0, 0.0 if link.armed else 1.0])
        self._place = x.p + up if p is None else np.asarray(p, dtype=float)
        self._heading = heading_of(x.R) if yaw is None else yaw
        self.hold(time.monotonic() + 0.5)  # PX4 needs a setpoint before the mode change
        self._ask(self._offboard, SET_MODE, (1.0, *map(float, OFFBOARD)), SWITCH_S, keep_on, "offboard mode")
        self._is_engaged = True
        self._ask(lambda: link.armed, ARM_DISARM, (1.0,), ARM_S, keep_on, "to be armed")
        if not self.until(self.staying(self._place, self._tell), GO_S, keep_on):
            raise PlantError(
                f"the autopilot is at {self.reading().p.round(2).tolist()} m after {GO_S:g} s, not at "
                f"{self._place.round(2).tolist()}{self._status_text()}"
            )
        link.thrusts.clear()
        self.hold(time.monotonic() + THRUST_S)
        self.thrust.learn(link.thrusts)

    def hold(self, until: float) -> None:
        """Let PX4 hold the take-off position until an instant on the monotonic clock [s]."""
        while time.monotonic() < until:
            self._tell()
            self.link.pump(min(until, time.monotonic() + TELL_EVERY_S))

    def read(self) -> VehicleState:
        """Return the newest state that PX4 has sent."""
        link = self.link
        link.pump(0.0)
        now, x, truth = time.monotonic(), self.reading(), link.truth
        if now - link.last_message > LOST_S:
            raise PlantError(f"the link has been silent for {LOST_S:g} s; the autopilot does what its failsafe says")
        if self._is_engaged and not (self._offboard() and link.armed):
            raise PlantError(f"the autopilot has left offboard mode, for mode {link.mode}{self._status_text()}")
        fresh_truth = None if truth is None or now - truth.stamp > LOST_S else truth.at(now)
        return x.at(now)._replace(truth=fresh_truth)

    def transmit(self, u: np.ndarray) -> np.ndarray:
        """Send thrust and body rates."""
        thrust = self.thrust.command(float(u[0]))
        self.link.fly_rates(thrust, u[1:])
        return np.concatenate([[self.thrust.per_mass(thrust)], u[1:]])

    def wait(self, until: float) -> None:
        """Keep the link alive."""
        self.link.pump(until)

    def land(self) -> None:
        """Order PX4 to land, wait until it has landed, and disconnect; do not land if a pilot has taken over."""
        link, self._link = self._link, None
        if link is None:
            return
        try:
            link.pump(0.0)
            if self._is_engaged and link.mode[0] == OFFBOARD[0] and link.armed:

                def order() -> None:
                    if link.mode[0] == OFFBOARD[0]:
                        link.command(SET_MODE, 1.0, *map(float, LAND))

                over = lambda: not link.armed or time.monotonic() - link.last_message > LOST_S  # noqa: E731
                wait_until(insisting(order, over, ASK_AGAIN_S), LANDING_S, lambda: True, link.pump)
        finally:
            self._is_engaged = False
            link.close()

    def _offboard(self) -> bool:
        return self.link.mode[0] == OFFBOARD[0]

    def _tell(self) -> None:
        """Send the position setpoint periodically."""
        if time.monotonic() - self._last_note >= TELL_EVERY_S:
            self._last_note = time.monotonic()
            self.link.fly_to(self._place, self._heading)

    def _ask(
        self, done: KeepOn, number: int, parameters: tuple[float, ...], patience: float, keep_on: KeepOn, what: str
    ) -> None:
        """Repeat a command until its effect is visible."""

        def is_obedient() -> bool:
            self._tell()
            return done()

        asking = insisting(lambda: self.link.command(number, *parameters), is_obedient, ASK_AGAIN_S)
        if not self.until(asking, patience, keep_on):
            raise PlantError(f"{self.address}: the autopilot refuses {what}{self._status_text()}")

    def _status_text(self) -> str:
        remark = f"; ignored: {'; '.join(self.link.notes)}" if self.link.notes else ""
        return remark + (f"; it said: {'; '.join(self.link.texts)}" if self.link.texts else "")

    @property
    def notes(self) -> Sequence[str]:
        """Kinds of ignored messages from the vehicle."""
        return () if self._link is None else tuple(self._link.notes)


entry = PlantEntry(
    lambda request: MavlinkPlant(request.address, request.dt, *request.limits),
    "a vehicle, or a simulation, that PX4 flies",
    is_vehicle=True,
    check_address=lambda address: address_of(address or ADDRESS),
    needs=lambda: check_extra("pymavlink", "mavlink", package="pymavlink"),
)
