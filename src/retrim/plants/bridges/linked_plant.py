"""Plants for a vehicle that is reached over a link, reports its state, and accepts thrust and body rates."""

from collections.abc import Collection
from typing import Generic, Protocol, TypeVar, runtime_checkable

import numpy as np

from ...errors import PlantError
from ...physics.state import STANDARD_GRAVITY
from .vehicle_plant import VehiclePlant
from .vehicle_state import Reading


@runtime_checkable
class VehicleLink(Protocol):
    """Attributes that every link provides."""

    @property
    def reading(self) -> Reading | None:
        """Newest state; None until the first one arrives."""

    @property
    def last_message(self) -> float:
        """Time of the last received message, on the monotonic clock [s]."""


L = TypeVar("L", bound=VehicleLink)


class LinkedPlant(VehiclePlant, Generic[L]):
    """A plant that has a link while it is connected."""

    def __init__(self, address: str, dt: float, low: np.ndarray, high: np.ndarray) -> None:
        """Build a plant.

        Args:
            address: Address of the vehicle, for error messages.
            dt: Control period [s].
            low: Smallest command [c, omega] that is sent to the vehicle.
            high: Largest command [c, omega] that is sent to the vehicle.
        """
        super().__init__(dt, low, high)
        self.address = address
        self._link: L | None = None

    @property
    def link(self) -> L:
        """Link to the vehicle.

        Raises:
            PlantError: The plant is not connected.
        """
        if self._link is None:
            raise PlantError(f"{self.address}: not connected; call connect or reset first")
        return self._link

    def reading(self) -> Reading:
        """Return the newest received state.

        Raises:
            PlantError: The vehicle has not sent a state yet.
        """
        if self.link.reading is None:
            raise PlantError(f"{self.address}: the vehicle has sent no state")
        return self.link.reading


class ThrustScale:
    """Linear scale between thrust per mass and an autopilot's thrust command, identified while the vehicle hovers."""

    def __init__(self, smallest: float, largest: float) -> None:
        """Build a scale that is not identified yet.

        Args:
            smallest: Smallest command that is sent.
            largest: Largest command that is sent.
        """
        self._range = smallest, largest
        self.hover: float | None = None
        """Command at hover; None until the vehicle has hovered."""

    def learn(self, commands: Collection[float]) -> None:
        """Identify the scale.

        Args:
            commands: The autopilot's thrust commands at hover.

        Raises:
            PlantError: There are too few commands, or they cannot come from a hovering vehicle.
        """
        shares = np.array(commands) / self._range[1]
        if len(shares) < 5 or not 0.05 < np.median(shares) < 0.95:
            raise PlantError(
                f"the thrust at hover is not known: the autopilot reported {shares.round(2).tolist()} of its largest"
            )
        self.hover = float(np.mean(np.array(commands)))

    def command(self, c: float) -> float:
        """Return the command for a thrust per mass [m/s^2], clipped to the range.

        Raises:
            PlantError: The vehicle has not hovered yet.
        """
        return float(np.clip(c / self._step, *self._range))

    def per_mass(self, command: float) -> float:
        """Return the thrust per mass for a command [m/s^2].

        Raises:
            PlantError: The vehicle has not hovered yet.
        """
        return command * self._step

    @property
    def _step(self) -> float:
        """Thrust per mass for a command of one [m/s^2]."""
        if self.hover is None:
            raise PlantError("the vehicle has not taken off; call take_off or reset first")
        return STANDARD_GRAVITY / self.hover
