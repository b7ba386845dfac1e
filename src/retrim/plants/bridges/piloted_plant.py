"""Base class of plants for a vehicle that another pilot takes off, hands over, and takes back."""

import math
import time
from typing import Protocol, TypeVar, runtime_checkable

import numpy as np

from ...errors import PlantError
from ...physics.state import STANDARD_GRAVITY
from .frames import heading_of
from .linked_plant import LinkedPlant, VehicleLink
from .polling import KeepOn
from .target_guardian import SINK, SINK_BY_FILE, TargetGuardian
from .vehicle_state import VehicleState

# [s], limits for the first state, for the flight to the start, and for the start of the guardian
WAIT_S, GO_S, READY_S = 10.0, 120.0, 20.0
LOST_S = 1.5  # [s] of silence; after 2 s the guard would stop the motors
HEADING = math.radians(20.0)


@runtime_checkable
class TargetLink(VehicleLink, Protocol):
    """A link that sends thrust and body rates."""

    def fly_rates(self, thrust: float, omega: np.ndarray) -> None:
        """Send a target: share of the motors' thrust, and body rates in our frame [rad/s]."""

    def target_guardian(self) -> TargetGuardian:
        """Start a guardian that publishes on the same topic."""

    def level_target(self, thrust: float, yaw: float) -> bytes:
        """Return a serialised target: share of the motors' thrust, level attitude, and heading [rad]."""

    def close(self) -> None:
        """Leave the network."""


L = TypeVar("L", bound=TargetLink)


class PilotedPlant(LinkedPlant[L]):
    """A vehicle that is handed over.

    The other pilot (mavros, or a flight stack's pilot) takes off, flies the vehicle to the start, and follows our
    targets while they are published. The other pilot takes back control when the targets stop. Some stacks hold the
    last target instead; a guardian therefore publishes a level one when the link ends. Thrust per mass is converted to
    a share of the motors' thrust using the vehicle's mass and largest thrust; adaptation compensates for errors in
    these values.
    """

    def __init__(self, address: str, dt: float, low: np.ndarray, high: np.ndarray, strongest: float) -> None:
        """Build a plant.

        Args:
            address: Address of the vehicle, for error messages.
            dt: Control period [s].
            low: Smallest command [c, omega].
            high: Largest command [c, omega].
            strongest: Total thrust per mass with all motors at full throttle [m/s^2].
        """
        super().__init__(address, dt, low, high)
        self.strongest = strongest
        """Total thrust per mass at full throttle [m/s^2]."""
        self._guardian: TargetGuardian | None = None

    def take_off(self, p: np.ndarray | None, yaw: float | None, keep_on: KeepOn = lambda: True) -> None:
        """Wait until another pilot has flown the vehicle to the start and the vehicle stays there."""
        guardian = self._guardian = self._guardian or self.link.target_guardian()
        guardian.release()  # from an earlier start
        x = self.reading()
        place = x.p if p is None else np.asarray(p, dtype=float)
        stays = self.staying(place)

        def ready() -> bool:
            away = 0.0 if yaw is None else heading_of(self.reading().R) - yaw
            return stays() and abs(math.remainder(away, math.tau)) < HEADING

        if not self.until(ready, GO_S, keep_on):
            x = self.reading()
            raise PlantError(
                f"{self.address}: the vehicle was not flown to {place.round(2).tolist()} m"
                f"{'' if yaw is None else f', heading {math.degrees(yaw):.0f} deg'}, in {GO_S:g} s; it is at "
                f"{x.p.round(2).tolist()} m, {math.degrees(heading_of(x.R)):.0f} deg"
            )
        share = SINK if self._learn_thrust(keep_on) else SINK_BY_FILE
        if not self.until(guardian.is_ready, READY_S, keep_on):
            raise PlantError(f"{self.address}: the node of the guardian has not started in {READY_S:g} s")
        thrust = min(1.0, share * STANDARD_GRAVITY / self.strongest)
        guardian.guard(self.link.level_target(thrust, heading_of(self.reading().R)))

    def hold(self, until: float) -> None:
        """Let the other pilot hold the vehicle's position."""
        self.wait(until)

    def read(self) -> VehicleState:
        """Return the newest state."""
        now, link = time.monotonic(), self.link
        if now - link.last_message > LOST_S:
            raise PlantError(f"no state has come for {LOST_S:g} s; the other pilot has control again")
        return self.reading().at(now)

    def transmit(self, u: np.ndarray) -> np.ndarray:
        """Publish a target."""
        thrust = float(np.clip(u[0] / self.strongest, 0.0, 1.0))
        self.link.fly_rates(thrust, u[1:])
        if self._guardian is not None:
            self._guardian.feed()
        return np.concatenate([[thrust * self.strongest], u[1:]])

    def wait(self, until: float) -> None:
        """Wait; messages are received in other threads."""
        time.sleep(max(0.0, until - time.monotonic()))

    def land(self) -> None:
        """Stop publishing, so the other pilot takes back control; the last target is a level one."""
        link, self._link = self._link, None
        guardian, self._guardian = self._guardian, None
        if guardian is not None:
            guardian.close()
        if link is not None:
            link.close()

    def _learn_thrust(self, keep_on: KeepOn) -> bool:
        """Identify the thrust at hover, if the vehicle publishes it, and return whether it does."""
        return False
