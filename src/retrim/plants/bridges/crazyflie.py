"""A Crazyflie as a plant: it takes off by itself, hands over control, and lands when the flight is over."""

import socket
import time

import numpy as np

from ...errors import ConfigError, PlantError
from ..entry import PlantEntry
from . import crtp
from .crazyflie_link import CrazyflieLink
from .endpoint import UdpEndpoint, address_of, address_towards
from .frames import heading_of
from .guardian import Guardian, Phase, SafeCommands
from .linked_plant import LinkedPlant, ThrustScale
from .polling import KeepOn, insisting
from .vehicle_state import VehicleState

ADDRESS = "udp:127.0.0.1:19850"  # of a simulated Crazyflie, or a bridge to the radio, on this machine
ANSWERS_S, READY_S, REST_S, ARM_S, APPROACH_S, LANDING_S = 5.0, 20.0, 2.0, 5.0, 20.0, 15.0  # [s]
REPEAT_S = 1.0  # [s] after which an order without effect is sent again
LOST_S = 2.0  # [s] of silence; by then the Crazyflie has stopped its motors
WANDERS = 0.1  # [m], largest change in the estimated position while it stands still
SPEED, RISE_S = 0.5, 2.0  # [m/s] during the flight to the start; [s] of a take-off
THRUST_S = 2.0  # [s] over which the thrust at hover is identified
GROUND = 0.1  # [m] above its take-off height
ORDER_EVERY_S, ORDERS_S = 0.05, 0.25  # [s]: the guardian repeats the order to land, since a radio loses packets
FAULT_TEXTS = {crtp.TUMBLED: "lies on its back", crtp.LOCKED: "has locked itself", crtp.CRASHED: "has crashed"}


class CrazyfliePlant(LinkedPlant[CrazyflieLink]):
    """A Crazyflie that receives thrust and body rates as manual setpoints via CRTP over UDP, and logs its state.

    The Crazyflie's world and body frames are the same as ours. Thrust per mass is the thrust command times
    g, divided by the thrust command at hover. Adaptation compensates for errors from the battery and the thrust map.
    """

    def __init__(self, address: str, dt: float, low: np.ndarray, high: np.ndarray) -> None:
        """Build a plant; it does not send packets until it connects.

        Args:
            address: ``udp:HOST:PORT`` that the Crazyflie listens on.
            dt: Control period [s].
            low: Smallest command [c, omega].
            high: Largest command [c, omega].

        Raises:
            ConfigError: The address is invalid, or the control period is outside the supported range.
        """
        super().__init__(check_address(address), dt, low, high)
        if not 0.01 <= dt <= 0.1:
            raise ConfigError(f"dt = {dt} s: a Crazyflie is commanded at 10 to 100 Hz")
        self.thrust = ThrustScale(*crtp.THRUST)
        self._flies, self._floor = False, 0.0
        self._guardian: Guardian | None = None

    def connect(self, keep_on: KeepOn = lambda: True) -> None:
        """Connect, and wait until the Crazyflie has a position estimate and can be armed."""
        if self._link is None:
            _, host, port = address_of(self.address)
            try:
                to = (socket.gethostbyname(host), port)
            except OSError as error:
                raise PlantError(f"{self.address}: no such host ({error})") from error
            self._link = CrazyflieLink(UdpEndpoint(address_towards(*to), 0), to)
        elif self._link.reading is not None:
            return
        link = self._link
        try:
            link.start_logs(ANSWERS_S, keep_on)
        except PlantError as error:
            raise PlantError(f"{self.address}: {error}{link.console_text()}") from error
        able = crtp.CAN_ARM | crtp.ARMED
        if not self.until(lambda: bool(link.reading and self._is(able)), READY_S, keep_on):
            raise PlantError(f"{self.address}: it cannot be armed in {READY_S:g} s{link.console_text()}")
        if not self._is(crtp.FLYING):
            self._stands_still(keep_on)

    def take_off(self, p: np.ndarray | None, yaw: float | None, keep_on: KeepOn = lambda: True) -> None:
        """Fly to a position using the Crazyflie's own commander, and identify the thrust command at hover."""
        link, x = self.link, self.reading()
        self._release_guardian()  # from an earlier start
        if not self._is(crtp.FLYING):
            self._floor = float(x.p[2])
        place = x.p + np.array([0.0, 0.0, 1.0]) if p is None else np.asarray(p, dtype=float)
        heading = heading_of(x.R) if yaw is None else yaw
        self._flies = True  # from now on it must be landed and disarmed
        ready = lambda: self._is(crtp.ARMED) and self._is(crtp.CAN_FLY)  # noqa: E731
        arming = insisting(lambda: link.send(crtp.arm(True, link.version)), ready, REPEAT_S)
        if not self.until(arming, ARM_S, keep_on):
            raise PlantError(f"{self.address}: the Crazyflie refuses to be armed{link.console_text()}")
        if not self._is(crtp.FLYING):
            rise = crtp.take_off(float(place[2]), heading, RISE_S)
            rising = insisting(lambda: link.send(rise), lambda: self._is(crtp.FLYING), REPEAT_S)
            if not self.until(rising, ARM_S, keep_on):
                raise PlantError(f"{self.address}: the Crazyflie does not take off{link.console_text()}")
            self.until(lambda: False, RISE_S, keep_on)

        def go() -> None:
            way = max(1.0, float(np.linalg.norm(place - self.reading().p)) / SPEED)
            link.send(crtp.go_to(place, heading, way, link.version))

        patience = APPROACH_S + float(np.linalg.norm(place - self.reading().p)) / SPEED
        if not self.until(insisting(go, self.staying(place), 0.5 * APPROACH_S), patience, keep_on):
            at, target = (each.round(2).tolist() for each in (self.reading().p, place))
            raise PlantError(
                f"{self.address}: it is at {at} m after {patience:.0f} s, not at {target}{link.console_text()}"
            )
        link.thrusts.clear()
        self.hold(time.monotonic() + THRUST_S)
        self.thrust.learn(link.thrusts)
        self._guardian = link.guard(landing_orders(self._floor, float(place[2]) - self._floor))

    def read(self) -> VehicleState:
        """Return the newest logged state."""
        link = self.link
        link.pump(0.0)
        now = time.monotonic()
        if now - link.last_message > LOST_S:
            raise PlantError(f"the link has been silent for {LOST_S:g} s; a Crazyflie stops its motors then")
        for bit, what in FAULT_TEXTS.items():
            if self._is(bit):
                raise PlantError(f"the Crazyflie reports that it {what}{link.console_text()}")
        if self._flies and not self._is(crtp.ARMED):
            raise PlantError(f"the Crazyflie is no longer armed{link.console_text()}")
        return self.reading().at(now)

    def transmit(self, u: np.ndarray) -> np.ndarray:
        """Send thrust and body rates."""
        thrust = round(self.thrust.command(float(u[0])))
        self.link.send(crtp.rates_setpoint(thrust, u[1:]))
        if self._guardian is not None:
            self._guardian.feed()
        return np.concatenate([[self.thrust.per_mass(float(thrust))], u[1:]])

    def wait(self, until: float) -> None:
        """Keep the link alive."""
        self.link.pump(until)

    def land(self) -> None:
        """Land the Crazyflie using its own commander, and disarm it; ignore a vehicle that no longer responds."""
        link, self._link = self._link, None
        self._release_guardian()
        if link is None:
            return
        try:
            if self._flies and link.reading is not None:
                self._sink(link)
            link.stop_logs()
        finally:
            self._flies, self.thrust.hover = False, None
            link.close()

    def _sink(self, link: CrazyflieLink) -> None:
        """Land with repeated orders, since orders may be lost."""
        reading = link.reading
        assert reading is not None
        until = time.monotonic() + LANDING_S
        while time.monotonic() < min(until, link.last_message + LOST_S):
            height = reading.p[2] - self._floor
            if height < GROUND:
                break
            link.send(crtp.relax())
            link.send(crtp.land(self._floor, max(1.0, height / SPEED)))
            last_order = time.monotonic()
            while time.monotonic() < min(until, last_order + 1.5 + height / SPEED) and height > 0.5 * GROUND:
                link.pump(time.monotonic() + 0.05)
                height = (link.reading or reading).p[2] - self._floor
            reading = link.reading or reading
        for order in (crtp.stop_planning(), crtp.arm(False, link.version)):
            link.send(order)
            link.pump(time.monotonic() + 0.1)

    def _release_guardian(self) -> None:
        guardian, self._guardian = self._guardian, None
        if guardian is not None:
            guardian.release()

    def _is(self, bits: int) -> bool:
        """Return whether the Crazyflie's supervisor reports any of these bits."""
        status = self.link.status
        return status is not None and bool(status.info & bits)

    def _stands_still(self, keep_on: KeepOn) -> None:
        """Check that the position estimate does not drift, as happens without a positioning system."""
        first = self.reading().p
        wanders = 0.0

        def is_away() -> bool:
            nonlocal wanders
            wanders = max(wanders, float(np.abs(self.reading().p - first).max()))
            return False

        self.until(is_away, REST_S, keep_on)
        if wanders > WANDERS:
            raise PlantError(
                f"{self.address}: the Crazyflie is at rest, and its estimate drifted by {wanders:.2f} m "
                f"in {REST_S:g} s; is there a positioning system?"
            )


def landing_orders(floor: float, height: float) -> SafeCommands:
    """Return a guardian's packets: the setpoints have ended, and the Crazyflie's own commander lands it.

    Args:
        floor: Height at which it took off [m].
        height: Height of the start above the floor [m]; the flight may be higher, so the landing takes twice as long.
    """
    landing = crtp.land(floor, max(RISE_S, 2.0 * height / SPEED))
    return SafeCommands((Phase((crtp.relax().pack(), landing.pack()), ORDER_EVERY_S, ORDERS_S),))


def check_address(address: str) -> str:
    """Check a Crazyflie's address and return it, or return the default for an empty address.

    Raises:
        ConfigError: The text is not a UDP address.
    """
    if address_of(address or ADDRESS)[0] != "udp":
        raise ConfigError(f"address {address!r}: a Crazyflie needs udp:HOST:PORT, as {ADDRESS}")
    return address or ADDRESS


entry = PlantEntry(
    lambda request: CrazyfliePlant(request.address, request.dt, *request.limits),
    "a Crazyflie, or a simulated one, by CRTP over UDP",
    is_vehicle=True,
    check_address=check_address,
)
