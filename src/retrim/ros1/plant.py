"""A vehicle behind ROS 1 as a plant: another pilot takes off, hands over control, and takes control back."""

import re

import numpy as np

from ..errors import ConfigError, PlantError
from ..plants.bridges.piloted_plant import WAIT_S
from ..plants.bridges.polling import KeepOn
from ..plants.bridges.target_plant import TargetPlant
from ..plants.entry import PlantEntry, PlantRequest
from .link import ODOMETRY, POSE, RosLink
from .node import system_module

MASTER, NAMESPACE = "127.0.0.1:11311", "/mavros"
ADDRESS = re.compile(r"(?P<master>[\w.-]+:\d{1,5})(?P<namespace>(/\w+)*)")


class RosPlant(TargetPlant[RosLink]):
    """A vehicle whose states and targets are ROS 1 topics; the world and body frames are the ROS frames, as are ours.

    The other pilot is mavros, or a flight stack's pilot.
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
        super().__init__(f"ros:{self.master}", dt, low, high, strongest)

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
