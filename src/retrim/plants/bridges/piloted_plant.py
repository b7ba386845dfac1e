"""Base class of plants for a vehicle that another pilot takes off, hands over, and takes back."""

import math
import time
from typing import Protocol, TypeVar, runtime_checkable

import numpy as np

from ...errors import PlantError
from .frames import heading_of
from .linked_plant import LinkedPlant, VehicleLink
from .polling import KeepOn
from .vehicle_state import VehicleState

WAIT_S, APPROACH_S = 10.0, 120.0  # [s], limits for the first state, and for the flight to the start
LOST_S = 1.5  # [s] of silence; after 2 s the guard would stop the motors
HEADING = math.radians(20.0)


@runtime_checkable
class TargetLink(VehicleLink, Protocol):
    """A link that sends thrust and body rates."""

    def fly_rates(self, thrust: float, omega: np.ndarray) -> None:
        """Send a target: share of the motors' thrust, and body rates in our frame [rad/s]."""

    def close(self) -> None:
        """Leave the network."""


L = TypeVar("L", bound=TargetLink)


class PilotedPlant(LinkedPlant[L]):
    """A vehicle that is handed over.

    The other pilot (mavros, or a flight stack's pilot) takes off, flies the vehicle to the start, and follows our
    targets while they are published. The other pilot takes back control when the targets stop.
    """

    def take_off(self, p: np.ndarray | None, yaw: float | None, keep_on: KeepOn = lambda: True) -> None:
        """Wait until another pilot has flown the vehicle to the start and the vehicle stays there."""
        x = self.reading()
        place = x.p if p is None else np.asarray(p, dtype=float)
        stays = self.staying(place)

        def ready() -> bool:
            away = 0.0 if yaw is None else heading_of(self.reading().R) - yaw
            return stays() and abs(math.remainder(away, math.tau)) < HEADING

        if not self.until(ready, APPROACH_S, keep_on):
            x = self.reading()
            raise PlantError(
                f"{self.address}: the vehicle was not flown to {place.round(2).tolist()} m"
                f"{'' if yaw is None else f', heading {math.degrees(yaw):.0f} deg'}, in {APPROACH_S:g} s; it is at "
                f"{x.p.round(2).tolist()} m, {math.degrees(heading_of(x.R)):.0f} deg"
            )

    def read(self) -> VehicleState:
        """Return the newest state."""
        now, link = time.monotonic(), self.link
        if now - link.last_message > LOST_S:
            raise PlantError(f"no state has come for {LOST_S:g} s; the other pilot has control again")
        return self.reading().at(now)

    def wait(self, until: float) -> None:
        """Wait; messages are received in other threads."""
        time.sleep(max(0.0, until - time.monotonic()))

    def land(self) -> None:
        """Stop publishing, so the other pilot takes back control."""
        link, self._link = self._link, None
        if link is not None:
            link.close()
