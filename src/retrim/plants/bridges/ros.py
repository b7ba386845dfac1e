"""A vehicle behind ROS 1, as a plant: somebody else takes off, hands over, and takes back."""

import math
import re
import time

import numpy as np

from ...errors import ConfigError, PlantError
from .frames import heading_of
from .linked_plant import LinkedPlant
from .patience import KeepOn
from .ros_link import ODOMETRY, POSE, RosLink
from .vehicle_state import VehicleState

MASTER, NAMESPACE = "127.0.0.1:11311", "/mavros"
HEARD_S, GO_S = 10.0, 120.0  # [s] to be heard; to be flown to the start
LOST_S = 1.0  # [s] of silence
ADDRESS = re.compile(r"(?P<master>[\w.-]+:\d{1,5})(?P<namespace>(/\w+)*)")
HEADING = math.radians(20.0)


class RosPlant(LinkedPlant[RosLink]):
    """A vehicle whose states and targets are topics of ROS 1.

    World and body are those of ROS, which are ours. Who flies it (mavros, a pilot of a flight stack) takes off, flies
    it to the start, follows our targets while they come, and takes it back when they stop. Thrust per mass becomes a
    share of the motors' thrust by the vehicle's mass and largest thrust; errors of these are left to adaptation.
    """

    def __init__(self, address: str, dt: float, low: np.ndarray, high: np.ndarray, strongest: float) -> None:
        """Build a plant; nothing is joined before it connects.

        Args:
            address: ``HOST:PORT`` of the rosmaster, with ``/NAMESPACE`` of the topics or without.
            dt: Control period [s].
            low: Smallest command [c, omega].
            high: Largest one.
            strongest: Thrust per mass of all motors at their end [m/s^2].

        Raises:
            ConfigError: The address is none.
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
        if not self.until(lambda: link.reading is not None, HEARD_S, keep_on):
            raise PlantError(
                f"{self.address}: neither {self.namespace}/{ODOMETRY} nor {self.namespace}/{POSE} came in {HEARD_S:g} s"
            )

    def take_off(self, p: np.ndarray | None, yaw: float | None, keep_on: KeepOn = lambda: True) -> None:
        """Wait until somebody has flown it to the start, and it stays there."""
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
        """Leave it to who flies it."""
        self.wait(until)

    def read(self) -> VehicleState:
        """Return the newest state."""
        now, link = time.monotonic(), self.link
        if now - link.heard > LOST_S:
            raise PlantError(f"no state has come for {LOST_S:g} s; who else flies the vehicle has it back")
        return self.reading().at(now)

    def transmit(self, u: np.ndarray) -> np.ndarray:
        """Publish a target."""
        thrust = float(np.clip(u[0] / self._strongest, 0.0, 1.0))
        self.link.fly_rates(thrust, u[1:])
        return np.concatenate([[thrust * self._strongest], u[1:]])

    def wait(self, until: float) -> None:
        """Wait; rospy hears by itself."""
        time.sleep(max(0.0, until - time.monotonic()))

    def land(self) -> None:
        """Publish no more: who else flies it takes it back."""
        link, self._link = self._link, None
        if link is not None:
            link.close()


def parts_of(address: str) -> tuple[str, str]:
    """Return HOST:PORT of a rosmaster and the namespace of the topics; what is usual if it is empty.

    Raises:
        ConfigError: It is no address.
    """
    found = ADDRESS.fullmatch(address or MASTER)
    if found is None or not 0 < int(found["master"].rpartition(":")[2]) < 65_536:
        raise ConfigError(f"address {address!r}: expected HOST:PORT of a rosmaster, with /NAMESPACE or without")
    return found["master"], found["namespace"] or NAMESPACE
