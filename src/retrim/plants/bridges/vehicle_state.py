"""What a vehicle says of itself, and what follows from it for the present."""

from typing import NamedTuple

import numpy as np

from ...physics.state import STANDARD_GRAVITY

LONGEST_S = 0.05  # [s] over which a state is carried on; what is older is too old to say more


class VehicleState(NamedTuple):
    """A state in NumPy, and how old it is."""

    p: np.ndarray
    """World [m]."""
    R: np.ndarray
    """Body to world."""
    v: np.ndarray
    """World [m/s]."""
    omega: np.ndarray
    """Body rates [rad/s]."""
    age: float
    """Time since this was so [s]."""
    truth: "VehicleState | None" = None
    """As it is, where a simulator behind the autopilot tells it."""
    carried: float = 0.0
    """By how much it has been carried on [s]; what the vehicle said is older than ``age`` by that."""

    @property
    def news(self) -> float:
        """Time since what the vehicle said of its state was so [s]."""
        return self.age + self.carried

    def carried_on(self, c: float) -> "VehicleState":
        """Return the state as it is now, by thrust, gravity and body rates, all constant; its age is what is left.

        States come at instants of the autopilot's, 5 to 20 ms old. Taken for the present they are a delay that no
        model has, and the times between them are no ticks. A controller makes up for the age that it is told, so none
        of what is made up for here may be in it.

        Args:
            c: Thrust per mass that was commanded last [m/s^2].
        """
        from scipy.spatial.transform import Rotation  # here: it takes as long to import as all of retrim

        h = min(self.age, LONGEST_S)
        a = c * self.R[:, 2] - np.array([0.0, 0.0, STANDARD_GRAVITY])
        turned = Rotation.from_rotvec(h * self.omega).as_matrix()
        truth = None if self.truth is None else self.truth.carried_on(c)
        return self._replace(
            p=self.p + h * self.v + 0.5 * h * h * a, R=self.R @ turned, v=self.v + h * a, truth=truth,
            age=self.age - h, carried=self.carried + h,
        )  # fmt: skip


class Reading(NamedTuple):
    """A state that a link has heard, in our frames."""

    stamp: float
    """When it was valid, by the monotonic clock of this machine [s]."""
    p: np.ndarray
    """World [m]."""
    R: np.ndarray
    """Body to world."""
    v: np.ndarray
    """World [m/s]."""
    omega: np.ndarray
    """Body rates [rad/s]."""

    def at(self, now: float) -> VehicleState:
        """Return it as a state with an age, at an instant of the same clock [s]."""
        return VehicleState(self.p, self.R, self.v, self.omega, max(0.0, now - self.stamp))
