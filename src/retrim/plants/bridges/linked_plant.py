"""A vehicle at the other end of a link, which tells its state and takes thrust and body rates."""

from collections.abc import Collection
from typing import Generic, Protocol, TypeVar, runtime_checkable

import numpy as np

from ...errors import PlantError
from ...physics.state import STANDARD_GRAVITY
from .vehicle_plant import VehiclePlant
from .vehicle_state import Reading


@runtime_checkable
class VehicleLink(Protocol):
    """What every link remembers."""

    reading: Reading | None
    """The newest state; None before the first."""
    heard: float
    """When anything came last, monotonic clock [s]."""


L = TypeVar("L", bound=VehicleLink)


class LinkedPlant(VehiclePlant, Generic[L]):
    """A plant that has a link while it is connected."""

    def __init__(self, address: str, dt: float, low: np.ndarray, high: np.ndarray) -> None:
        """Build a plant.

        Args:
            address: Where the vehicle is reached; what went wrong is told with it.
            dt: Control period [s].
            low: Smallest command [c, omega] that the vehicle is given.
            high: Largest one.
        """
        super().__init__(dt, low, high)
        self.address = address
        self._link: L | None = None

    @property
    def link(self) -> L:
        """The connection.

        Raises:
            PlantError: There is none.
        """
        if self._link is None:
            raise PlantError(f"{self.address}: not connected; call connect or reset first")
        return self._link

    def reading(self) -> Reading:
        """Return the newest state that was heard.

        Raises:
            PlantError: There is none yet.
        """
        if self.link.reading is None:
            raise PlantError(f"{self.address}: the vehicle has sent no state")
        return self.link.reading


class ThrustScale:
    """Between thrust per mass and an autopilot's thrust command, which is linear; learnt where the vehicle hovers."""

    def __init__(self, smallest: float, largest: float) -> None:
        """Build one that is not learnt yet.

        Args:
            smallest: The smallest command that is given.
            largest: The largest one.
        """
        self._range = smallest, largest
        self.hover: float | None = None
        """The command that carries the vehicle; None before it has hovered."""

    def learn(self, commands: Collection[float]) -> None:
        """Learn the scale.

        Args:
            commands: What the autopilot has commanded in hover.

        Raises:
            PlantError: They are too few, or none that carries a vehicle.
        """
        shares = np.array(commands) / self._range[1]
        if len(shares) < 5 or not 0.05 < np.median(shares) < 0.95:
            raise PlantError(
                f"the thrust at hover is not known: the autopilot said {shares.round(2).tolist()} of its largest"
            )
        self.hover = float(np.mean(np.array(commands)))

    def command(self, c: float) -> float:
        """Return the command for a thrust per mass [m/s^2], within the range.

        Raises:
            PlantError: The vehicle has not hovered.
        """
        return float(np.clip(c / self._step, *self._range))

    def per_mass(self, command: float) -> float:
        """Return the thrust per mass that a command stands for [m/s^2].

        Raises:
            PlantError: The vehicle has not hovered.
        """
        return command * self._step

    @property
    def _step(self) -> float:
        """Thrust per mass of a command of one [m/s^2]."""
        if self.hover is None:
            raise PlantError("the vehicle has not taken off; call take_off or reset first")
        return STANDARD_GRAVITY / self.hover
