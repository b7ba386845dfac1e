"""Base class of plants for a vehicle that another pilot takes off and flies to the start."""

import math
import time
from typing import TypeVar

import numpy as np

from ...errors import PlantError
from .frames import heading_of
from .linked_plant import LinkedPlant, VehicleLink
from .polling import KeepOn
from .vehicle_state import VehicleState

GO_S = 120.0  # [s], limit for the flight to the start
LOST_S = 1.5  # [s] of silence; after 2 s the guard would stop the motors
HEADING = math.radians(20.0)

L = TypeVar("L", bound=VehicleLink)


class ManualStartPlant(LinkedPlant[L]):
    """A vehicle that waits at the start, under another pilot, until it is handed over."""

    def await_start(self, p: np.ndarray | None, yaw: float | None, keep_on: KeepOn) -> np.ndarray:
        """Wait until another pilot has flown the vehicle to the start and the vehicle stays there; return the place.

        Args:
            p: Start, world [m]; None for the present position.
            yaw: Heading at the start [rad]; None for any heading.
            keep_on: Called repeatedly; the wait is given up when it returns False.

        Raises:
            PlantError: The vehicle is elsewhere after two minutes.
        """
        x = self.reading()
        place = x.p.copy() if p is None else np.asarray(p, dtype=float)
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
        return place

    def read(self) -> VehicleState:
        """Return the newest state."""
        now, link = time.monotonic(), self.link
        if now - link.last_message > LOST_S:
            raise PlantError(f"no state has come for {LOST_S:g} s; the other pilot has control again")
        return self.reading().at(now)
