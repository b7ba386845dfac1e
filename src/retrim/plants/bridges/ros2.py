"""A vehicle behind ROS 2 as a plant: PX4's own topics, or those of mavros."""

import time
from collections.abc import Callable, Mapping, Sequence
from typing import TypeVar

import numpy as np

from ...errors import ConfigError, PlantError
from ...physics.state import STANDARD_GRAVITY
from ...ros2.backends import choose_backend, is_installed, open_node
from ...ros2.node import Ros2Node
from ..entry import PlantEntry, PlantRequest
from .linked_plant import ThrustScale
from .offboard_plant import THRUST_S, OffboardPlant
from .polling import KeepOn
from .ros2_address import Ros2Address, address_of
from .ros2_link import ODOMETRY, POSE, MavrosLink, Ros2Link
from .ros2_px4_link import Px4Link
from .target_plant import TargetPlant

WAIT_S, LISTENER_S = 10.0, 5.0  # [s], limits for the first state, and for listeners to the setpoints
CROWD_S = 25.0  # [s] for which a killed node may still be listed
SAME_PACKAGES = "the same px4_msgs or mavros_msgs at both ends"
DISCOVERY_PERIOD_S = 0.5  # [s] between two looks at the other nodes
RATE_S, LOWEST_RATE = 1.2, 15.0  # [s], [Hz]: the guard refuses states that are older than 0.1 s
ENOUGH_THRUSTS = 5
PX4_STATE = "/fmu/out/vehicle_odometry"
MOST_STATES = 5  # in a message

L = TypeVar("L", bound=Ros2Link)
Wait = Callable[[KeepOn, float, KeepOn], bool]


def connect_link(address: Ros2Address, make: Callable[[Ros2Node, Ros2Address], L]) -> L:
    """Return a link through a new node.

    Raises:
        PlantError: There is no back end with the message types, or it cannot join the network.
    """
    try:
        node = open_node(address.backend, address.packages, address.router)
    except ConfigError as error:
        raise PlantError(str(error)) from error
    try:
        return make(node, address)
    except ConfigError as error:
        node.close()
        raise PlantError(str(error)) from error
    except BaseException:
        node.close()
        raise


def await_states(link: Ros2Link, until: Wait, keep_on: KeepOn) -> None:
    """Wait for states, and compare the message types of both ends, before anything is armed.

    Raises:
        PlantError: No state comes, too few come, the setpoints have no listener, or a type differs.
    """
    where, last_look = f"ros2 ({link.node.backend})", 0.0

    def is_clear() -> bool:
        nonlocal last_look
        if time.monotonic() - last_look > DISCOVERY_PERIOD_S:
            for fault in (*link.faults(), *(note for note in link.notes if "this end has" in note)):
                is_state = "PoseStamped" in fault and "Odometry" in fault
                remedy = "pose=TOPIC for poses, odometry=TOPIC for odometry" if is_state else SAME_PACKAGES
                raise PlantError(f"{where}: {fault}; use {remedy}")
            last_look = time.monotonic()
        return link.reading is not None

    if not until(is_clear, WAIT_S, keep_on):
        remarks = "".join(f"; ignored: {note}" for note in link.notes)
        remarks += f"; {advice(link.node.published_topics())}"
        raise PlantError(f"{where}: no state arrived on {' or '.join(link.states)} in {WAIT_S:g} s{remarks}")
    last_look = 0.0
    until(lambda: is_clear() and not link.topics_without_listener(), LISTENER_S, keep_on)
    if (
        silent := link.topics_without_listener()
    ) and link.node.backend != "zenoh":  # PX4's zenoh module does not announce itself.
        raise PlantError(f"{where}: no node subscribes to {', '.join(silent)}")
    if not until(lambda: not link.topics_with_several_publishers(), CROWD_S, keep_on):
        topics = ", ".join(link.topics_with_several_publishers())
        raise PlantError(f"{where}: several nodes publish {topics}; end all but one")
    until(lambda: False, RATE_S, keep_on)
    if link.rate < LOWEST_RATE:
        raise PlantError(
            f"{where}: states come at {link.rate:g} Hz; at least {LOWEST_RATE:g} Hz are needed on "
            f"{' or '.join(link.states)}"
        )


def advice(published: Mapping[str, str]) -> str:
    """Return the states that are available, as they are written in an address.

    Args:
        published: Topics on which other nodes publish, with their types.
    """
    options = {ODOMETRY: "odometry=", POSE: "pose="}
    states = sorted(options[kind] + topic for topic, kind in published.items() if kind in options)
    states += sorted(f"px4{topic.removesuffix(PX4_STATE)}" for topic in published if topic.endswith(PX4_STATE))
    if states:
        return f"other nodes publish states, for {' or '.join(states[:MOST_STATES])}"
    if published:
        return f"other nodes publish no odometry and no poses, but {', '.join(sorted(published)[:MOST_STATES])}"
    return "no other node was found: check the network, ROS_DOMAIN_ID and the back end"


class MavrosPlant(TargetPlant[MavrosLink]):
    """A vehicle behind mavros; thrust is scaled by the autopilot's thrust at hover, where mavros publishes it."""

    def __init__(self, address: str, dt: float, low: np.ndarray, high: np.ndarray, strongest: float) -> None:
        """Build a plant; it joins the network when it connects.

        Args:
            address: Back end, namespace and topics; see :mod:`.ros2_address`.
            dt: Control period [s].
            low: Smallest command [c, omega].
            high: Largest command [c, omega].
            strongest: Total thrust per mass with all motors at full throttle [m/s^2].

        Raises:
            ConfigError: The address is invalid.
        """
        self._where = address_of(address)
        super().__init__(f"ros2:{address}", dt, low, high, strongest)

    def connect(self, keep_on: KeepOn = lambda: True) -> None:
        """Wait for states, and compare the message types of both ends."""
        if self._link is None:
            self._link = connect_link(self._where, MavrosLink)
        await_states(self._link, self.until, keep_on)

    def _learn_thrust(self, keep_on: KeepOn) -> bool:
        """Read the autopilot's thrust at the start, if mavros publishes it."""
        link = self.link
        link.thrusts.clear()
        self.until(lambda: False, THRUST_S if self._is_reporting() else 0.0, keep_on)
        if len(link.thrusts) < ENOUGH_THRUSTS:
            return False
        scale = ThrustScale(0.0, 1.0)
        scale.learn(list(link.thrusts))
        self.strongest = scale.per_mass(1.0)
        return True

    @property
    def notes(self) -> Sequence[str]:
        """Kinds of ignored messages from the vehicle."""
        return () if self._link is None else tuple(self._link.notes)

    def _is_reporting(self) -> bool:
        self.wait(time.monotonic() + 0.3)
        return len(self.link.thrusts) > 0


class Px4Plant(OffboardPlant[Px4Link]):
    """A PX4 vehicle by its own topics. It takes off by itself, hands over control, and lands.

    Thrust is scaled by PX4's thrust at hover if ``vehicle_thrust_setpoint`` is published, and by the vehicle file
    otherwise.
    """

    def __init__(self, address: str, dt: float, low: np.ndarray, high: np.ndarray, strongest: float) -> None:
        """Build a plant; it joins the network when it connects.

        Args:
            address: Back end, namespace and topics; see :mod:`.ros2_address`.
            dt: Control period [s].
            low: Smallest command [c, omega].
            high: Largest command [c, omega].
            strongest: Total thrust per mass with all motors at full throttle [m/s^2].

        Raises:
            ConfigError: The address is invalid, or the control period is outside the range that PX4 supports.
        """
        self._where = address_of(address)
        super().__init__(f"ros2:{address}", dt, low, high)
        self._strongest = strongest

    def connect(self, keep_on: KeepOn = lambda: True) -> None:
        """Wait for states, and compare the message types of both ends, also by PX4's own answers."""
        if self._link is None:
            self._link = connect_link(self._where, Px4Link)
        await_states(self._link, self.until, keep_on)
        if fault := self._link.format_fault(keep_on):
            raise PlantError(f"{self.address}: {fault}; name the firmware's release, as in ros2:px4-1.14")

    def _learn_thrust(self) -> None:
        if len(self.link.thrusts) >= ENOUGH_THRUSTS:
            self.thrust.learn(list(self.link.thrusts))
        else:
            self.thrust.hover = STANDARD_GRAVITY / self._strongest


def _make(request: PlantRequest) -> MavrosPlant | Px4Plant:
    vehicle = request.vehicle
    kind = MavrosPlant if address_of(request.address).dialect == "mavros" else Px4Plant
    return kind(request.address, request.dt, *request.limits, float(vehicle.thrust_max / vehicle.mass))


def _check_installed() -> None:
    """Raise an error if the packages are missing, before anything is trained."""
    if not is_installed("rosbags"):
        raise PlantError(
            "plant 'ros2' needs the package 'rosbags'; in a checkout: `uv pip install -e '.[ros2]'`; elsewhere: "
            "`pip install cyclonedds rosbags`"
        )
    choose_backend(())


entry = PlantEntry(
    _make,
    "a vehicle behind ROS 2: PX4's own topics, or odometry or poses in and attitude targets out, as mavros has them",
    is_vehicle=True,
    check_address=address_of,
    needs=_check_installed,
)
