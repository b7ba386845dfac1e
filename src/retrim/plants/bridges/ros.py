"""A vehicle behind ROS 1 as a plant: another pilot takes off, hands over control, and takes control back."""

import math
import re
import time

import numpy as np

from ...errors import ConfigError, PlantError
from ...rospy_node import system_module
from ..entry import PlantEntry, PlantRequest
from .frames import heading_of
from .linked_plant import LinkedPlant
from .polling import KeepOn
from .ros_link import ODOMETRY, POSE, RosLink
from .vehicle_state import VehicleState

MASTER, NAMESPACE = "127.0.0.1:11311", "/mavros"
WAIT_S, GO_S = 10.0, 120.0  # [s], limits for the first state, and for the flight to the start
LOST_S = 1.0  # [s] of silence
ADDRESS = re.compile(r"(?P<master>[\w.-]+:\d{1,5})(?P<namespace>(/\w+)*)")
HEADING = math.radians(20.0)


class RosPlant(LinkedPlant[RosLink]):
    """A vehicle whose states and targets are ROS 1 topics.

    The world and body frames are the ROS frames, as are ours. The other pilot (mavros, or a flight stack's pilot)
    takes off, flies the vehicle to the start, and follows our targets while they are published. The other pilot
    takes back control when the targets stop. Thrust per mass is converted to a share of the motors' thrust using the
    vehicle's mass and largest thrust; adaptation compensates for errors in these values.
    """

    def __init__(self, address: str, dt: float, low: np.ndarray, high: np.ndarray, strongest: float) -> None:
        """Build a plant; it joins the ROS network when it connects.

        Args:
            address: ``HOST:PORT`` of the rosmaster, optionally with the ``/NAMESPACE`` of the topics.
            dt: Control period [s].
            low: Smallest command [c, omega].
            high: Largest command [c, omega].
            strongest: Total thrust per mass with all motors at full throttle [m/s^2].

        Raises:
            ConfigError: The address is invalid.
        """
        self.master, self.namespace = parts_of(address)
        super().__init__(f"ros:{self.master}", dt, low, high)
        self._strongest = strongest

    def connect(self, keep_on: KeepOn = lambda: True) -> None:
        """Wait for the first state."""
        if self._link is None:
            try:
                self._link = RosLink(f"http://{self.master}", self.namespace)
            except ConfigError as error:
                raise PlantError(str(error)) from error
        link = self._link
        if not self.until(lambda: link.reading is not None, WAIT_S, keep_on):
            raise PlantError(
                f"{self.address}: neither {self.namespace}/{ODOMETRY} nor {self.namespace}/{POSE} came in {WAIT_S:g} s"
            )

    def take_off(self, p: np.ndarray | None, yaw: float | None, keep_on: KeepOn = lambda: True) -> None:
        """Wait until another pilot has flown the vehicle to the start and the vehicle stays there."""
        x = self.reading()
        place = x.p if p is None else np.asarray(p, dtype=float)
        stays = self.staying(place)

        def ready() -> bool:
            away = 0.0 if yaw is None else heading_of(self.reading().R) - yaw
            return stays() and abs(math.remainder(away, math.tau)) < HEADING

        if not self.until(ready, GO_S, keep_on):
            x = self.reading()
            raise PlantError(
                f"{self.address}: nobody has flown the vehicle to {place.round(2).tolist()} m"
                f"{'' if yaw is None else f', heading {math.degrees(yaw):.0f} deg'}, in {GO_S:g} s; it is at "
                f"{x.p.round(2).tolist()} m, {math.degrees(heading_of(x.R)):.0f} deg"
            )

    def hold(self, until: float) -> None:
        """Let the other pilot hold the vehicle's position."""
        self.wait(until)

    def read(self) -> VehicleState:
        """Return the newest state."""
        now, link = time.monotonic(), self.link
        if now - link.last_message > LOST_S:
            raise PlantError(f"no state has come for {LOST_S:g} s; who else flies the vehicle has it back")
        return self.reading().at(now)

    def transmit(self, u: np.ndarray) -> np.ndarray:
        """Publish a target."""
        thrust = float(np.clip(u[0] / self._strongest, 0.0, 1.0))
        self.link.fly_rates(thrust, u[1:])
        return np.concatenate([[thrust * self._strongest], u[1:]])

    def wait(self, until: float) -> None:
        """Wait; rospy receives messages in its own threads."""
        time.sleep(max(0.0, until - time.monotonic()))

    def land(self) -> None:
        """Stop publishing, so the other pilot takes back control."""
        link, self._link = self._link, None
        if link is not None:
            link.close()


def parts_of(address: str) -> tuple[str, str]:
    """Return the HOST:PORT of a rosmaster and the topic namespace, or the defaults for an empty address.

    Raises:
        ConfigError: The text is not an address.
    """
    result = ADDRESS.fullmatch(address or MASTER)
    if result is None or not 0 < int(result["master"].rpartition(":")[2]) < 65_536:
        raise ConfigError(f"address {address!r}: expected HOST:PORT of a rosmaster, with /NAMESPACE or without")
    return result["master"], result["namespace"] or NAMESPACE


def _make(request: PlantRequest) -> RosPlant:
    vehicle = request.vehicle
    return RosPlant(request.address, request.dt, *request.limits, float(vehicle.thrust_max / vehicle.mass))


entry = PlantEntry(
    _make,
    "a vehicle behind ROS 1: odometry or poses in, attitude targets out, as mavros has them",
    is_vehicle=True,
    check_address=parts_of,
    needs=lambda: system_module("rospy"),
)
