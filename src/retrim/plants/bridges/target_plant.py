"""Base class of plants for a vehicle that another pilot hands over, and that follows published attitude targets."""

from typing import Protocol, TypeVar, runtime_checkable

import numpy as np

from ...errors import PlantError
from ...physics.state import STANDARD_GRAVITY
from .frames import heading_of
from .piloted_plant import PilotedPlant, TargetLink
from .polling import KeepOn
from .target_guardian import SINK_THRUST, SINK_THRUST_FROM_FILE, TargetGuardian

READY_S = 20.0  # [s], limit for the start of the guardian's node


@runtime_checkable
class GuardedLink(TargetLink, Protocol):
    """A link that publishes targets, and whose guardian publishes on the same topic."""

    def target_guardian(self) -> TargetGuardian:
        """Start a guardian with a node of its own."""

    def level_target(self, thrust: float, yaw: float) -> bytes:
        """Return a serialised target: share of the motors' thrust, level attitude, and heading [rad]."""


L = TypeVar("L", bound=GuardedLink)


class TargetPlant(PilotedPlant[L]):
    """A vehicle behind ROS.

    Thrust per mass is converted to a share of the motors' thrust using the vehicle's mass and largest thrust;
    adaptation compensates for errors in these values.

    Some stacks hold the last target for ever. A guardian therefore publishes a level one when the link ends or is
    silent, and at the end of a flight.
    """

    _guardian: TargetGuardian | None = None

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

    def take_off(self, p: np.ndarray | None, yaw: float | None, keep_on: KeepOn = lambda: True) -> None:
        """Wait until another pilot has flown the vehicle to the start, and start the guardian there."""
        guardian = self._guardian = self._guardian or self.link.target_guardian()
        guardian.release()  # from an earlier start
        super().take_off(p, yaw, keep_on)
        share = SINK_THRUST if self._learn_thrust(keep_on) else SINK_THRUST_FROM_FILE
        if not self.until(guardian.is_ready, READY_S, keep_on):
            raise PlantError(f"{self.address}: the node of the guardian has not started in {READY_S:g} s")
        thrust = min(1.0, share * STANDARD_GRAVITY / self.strongest)
        guardian.guard(self.link.level_target(thrust, heading_of(self.reading().R)))

    def transmit(self, u: np.ndarray) -> np.ndarray:
        """Publish a target."""
        thrust = float(np.clip(u[0] / self.strongest, 0.0, 1.0))
        self.link.fly_rates(thrust, u[1:])
        if self._guardian is not None:
            self._guardian.feed()
        return np.concatenate([[thrust * self.strongest], u[1:]])

    def land(self) -> None:
        """Stop publishing, so the other pilot takes back control; the last target is a level one."""
        guardian, self._guardian = self._guardian, None
        if guardian is not None:
            guardian.close()
        super().land()

    def _learn_thrust(self, keep_on: KeepOn) -> bool:
        """Identify the thrust at hover, if the vehicle publishes it, and return whether it does."""
        return False
