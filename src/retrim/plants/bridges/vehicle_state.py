"""Vehicle state estimates, extrapolated to the current time."""

from typing import NamedTuple

import numpy as np

from ...physics.state import STANDARD_GRAVITY

LONGEST_S = 0.05  # [s], limit of a state's extrapolation; an older state is not useful


class VehicleState(NamedTuple):
    """A state in NumPy arrays, with its age."""

    p: np.ndarray
    """Position in the world frame [m]."""
    R: np.ndarray
    """Attitude, body to world."""
    v: np.ndarray
    """Velocity in the world frame [m/s]."""
    omega: np.ndarray
    """Body rates [rad/s]."""
    age: float
    """Time since the state was valid [s]."""
    truth: "VehicleState | None" = None
    """True state, if a simulator behind the autopilot reports it."""
    extrapolation: float = 0.0
    """Extrapolated time [s]; the reported state is older than ``age`` by this amount."""

    @property
    def news(self) -> float:
        """Age of the state that the vehicle reported [s]."""
        return self.age + self.extrapolation

    def extrapolate(self, c: float) -> "VehicleState":
        """Return the state extrapolated to the current time with constant thrust, gravity and body rates.

        The extrapolation is limited to 50 ms; the new age is the time beyond this limit.

        The autopilot chooses when to send states, and they are 5 to 20 ms old when they arrive. If they were used as
        current states, they would add a delay that is not part of any model, and the intervals between them would not
        be ticks. A controller compensates for the reported age, so this age must not include the time that is already
        compensated for here.

        Args:
            c: Last commanded thrust per mass [m/s^2].
        """
        from scipy.spatial.transform import Rotation  # local, because it takes as long to import as all of retrim

        h = min(self.age, LONGEST_S)
        a = c * self.R[:, 2] - np.array([0.0, 0.0, STANDARD_GRAVITY])
        rotation = Rotation.from_rotvec(h * self.omega).as_matrix()
        truth = None if self.truth is None else self.truth.extrapolate(c)
        return self._replace(
            p=self.p + h * self.v + 0.5 * h * h * a, R=self.R @ rotation, v=self.v + h * a, truth=truth,
            age=self.age - h, extrapolation=self.extrapolation + h,
        )  # fmt: skip


class Reading(NamedTuple):
    """A state received by a link, in our frames."""

    stamp: float
    """Time at which the state was valid, on this machine's monotonic clock [s]."""
    p: np.ndarray
    """Position in the world frame [m]."""
    R: np.ndarray
    """Attitude, body to world."""
    v: np.ndarray
    """Velocity in the world frame [m/s]."""
    omega: np.ndarray
    """Body rates [rad/s]."""

    def at(self, now: float) -> VehicleState:
        """Return the reading as a state, with its age at an instant on the same clock [s]."""
        return VehicleState(self.p, self.R, self.v, self.omega, max(0.0, now - self.stamp))
