"""Base class of plants for PX4 in offboard mode, over any protocol."""

import abc
import math
import time
from collections import deque
from collections.abc import Sequence
from typing import Protocol, TypeVar, runtime_checkable

import numpy as np

from ...errors import ConfigError, PlantError
from .frames import heading_of
from .linked_plant import LinkedPlant, ThrustScale, VehicleLink
from .polling import KeepOn, insisting, wait_until
from .vehicle_state import Reading, VehicleState

OFFBOARD, LAND = (6, 0), (4, 6)  # main and sub mode
SET_MODE, ARM_DISARM = 176, 400  # MAV_CMD
SWITCH_S, ARM_S, APPROACH_S, LANDING_S = 5.0, 8.0, 40.0, 40.0  # [s]
REPEAT_S = 1.0  # [s]
LOST_S = 2.0  # [s] of silence, after which the autopilot's failsafe has long taken over
THRUST_S = 2.0  # [s] over which the thrust at hover is identified
SETPOINT_PERIOD_S = 0.05  # [s] between two position setpoints


@runtime_checkable
class OffboardLink(VehicleLink, Protocol):
    """A connection to PX4."""

    mode: tuple[int, int]
    """Main and sub mode."""
    armed: bool
    """Whether the motors are armed."""
    truth: Reading | None
    """True state from the autopilot's own simulator, if it is reported."""
    thrusts: deque[float]
    """The autopilot's thrust commands to its motors, as shares of the full thrust."""
    texts: deque[str]
    """Text messages from the autopilot."""
    notes: list[str]
    """Kinds of ignored messages, each listed once."""

    def pump(self, until: float) -> None:
        """Keep the connection alive until an instant on the monotonic clock [s]."""

    def command(self, number: int, *parameters: float) -> None:
        """Send a command of MAVLink; the autopilot's state shows its effect."""

    def fly_rates(self, thrust: float, omega: np.ndarray) -> None:
        """Send a setpoint: share of the motors' thrust, and body rates in our frame [rad/s]."""

    def fly_to(self, p: np.ndarray, yaw: float) -> None:
        """Send a setpoint: position [m] and heading [rad] in our frame."""

    def close(self) -> None:
        """Disconnect."""


L = TypeVar("L", bound=OffboardLink)


class OffboardPlant(LinkedPlant[L], abc.ABC):
    """A PX4 vehicle that receives thrust and body rates in offboard mode.

    The world frame is east, north, up from the origin of the autopilot's local frame. Thrust per mass is the share of
    the motors' thrust times g, divided by the share at hover. The share at hover is identified while the autopilot
    hovers before the hand-over. Adaptation compensates for a non-linear thrust map (``THR_MDL_FAC``), a sagging battery
    or a different load.
    """

    def __init__(self, address: str, dt: float, low: np.ndarray, high: np.ndarray) -> None:
        """Build a plant.

        Args:
            address: Address of the vehicle, for error messages.
            dt: Control period [s].
            low: Smallest command [c, omega].
            high: Largest command [c, omega].

        Raises:
            ConfigError: The control period is outside the range that PX4 supports.
        """
        super().__init__(address, dt, low, high)
        if not 0.004 <= dt <= 0.1:
            raise ConfigError(f"dt = {dt} s: PX4 is commanded at 10 to 250 Hz")
        self.thrust = ThrustScale(0.0, 1.0)
        """Scale of thrust commands; its range is the motors' full thrust."""
        self._is_engaged = False
        self._place, self._heading, self._last_note = np.zeros(3), 0.0, -math.inf

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
        if not self.until(self.staying(self._place, self._tell), APPROACH_S, keep_on):
            raise PlantError(
                f"the autopilot is at {self.reading().p.round(2).tolist()} m after {APPROACH_S:g} s, not at "
                f"{self._place.round(2).tolist()}{self._status_text()}"
            )
        link.thrusts.clear()
        self.hold(time.monotonic() + THRUST_S)
        self._learn_thrust()

    def hold(self, until: float) -> None:
        """Let PX4 hold the take-off position until an instant on the monotonic clock [s]."""
        while time.monotonic() < until:
            self._tell()
            self.link.pump(min(until, time.monotonic() + SETPOINT_PERIOD_S))

    def read(self) -> VehicleState:
        """Return the newest state that PX4 has sent."""
        link = self.link
        link.pump(0.0)
        now, x, truth = time.monotonic(), self.reading(), link.truth
        if now - link.last_message > LOST_S:
            raise PlantError(f"the link has been silent for {LOST_S:g} s; the autopilot follows its failsafe")
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
                wait_until(insisting(order, over, REPEAT_S), LANDING_S, lambda: True, link.pump)
        finally:
            self._is_engaged = False
            link.close()

    def _offboard(self) -> bool:
        return self.link.mode[0] == OFFBOARD[0]

    def _tell(self) -> None:
        """Send the position setpoint periodically."""
        if time.monotonic() - self._last_note >= SETPOINT_PERIOD_S:
            self._last_note = time.monotonic()
            self.link.fly_to(self._place, self._heading)

    def _ask(
        self, done: KeepOn, number: int, parameters: tuple[float, ...], patience: float, keep_on: KeepOn, what: str
    ) -> None:
        """Repeat a command until its effect is visible."""

        def is_obedient() -> bool:
            self._tell()
            return done()

        asking = insisting(lambda: self.link.command(number, *parameters), is_obedient, REPEAT_S)
        if not self.until(asking, patience, keep_on):
            raise PlantError(f"{self.address}: the autopilot refuses {what}{self._status_text()}")

    def _status_text(self) -> str:
        remark = f"; ignored: {'; '.join(self.link.notes)}" if self.link.notes else ""
        return remark + (f"; it said: {'; '.join(self.link.texts)}" if self.link.texts else "")

    def _learn_thrust(self) -> None:
        """Identify the thrust at hover from the autopilot's commands."""
        self.thrust.learn(self.link.thrusts)

    @property
    def notes(self) -> Sequence[str]:
        """Kinds of ignored messages from the vehicle."""
        return () if self._link is None else tuple(self._link.notes)
