"""Vehicle state estimates, extrapolated to the current time."""

from typing import NamedTuple

import numpy as np

from ...physics.state import STANDARD_GRAVITY

LONGEST_S = 0.05  # [s], limit of a state's extrapolation; an older state is not useful

SHORTEST_S, LONGEST_GAP_S = 4e-3, 0.2  # [s] between two states from which an acceleration is derived
AVERAGING_S = 0.3  # [s]
LARGEST = 10.0  # [m/s^2]


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

    def extrapolate(self, c: float, extra: np.ndarray | None = None) -> "VehicleState":
        """Return the state extrapolated to the current time with constant thrust, gravity and body rates.

        The extrapolation is limited to 50 ms; the new age is the time beyond this limit.

        The autopilot chooses when to send states, and they are 5 to 20 ms old when they arrive. If they were used as
        current states, they would add a delay that is not part of any model, and the intervals between them would not
        be ticks. A controller compensates for the reported age, so this age must not include the time that is already
        compensated for here.

        Args:
            c: Last commanded thrust per mass [m/s^2].
            extra: Acceleration in the world frame that neither thrust nor gravity explains, such as that of wind
                [m/s^2]. Without it, a steady wind would bias the velocity, and the vehicle would hover off its place.
        """
        from scipy.spatial.transform import Rotation  # local, because it takes as long to import as all of retrim

        h = min(self.age, LONGEST_S)
        a = c * self.R[:, 2] - np.array([0.0, 0.0, STANDARD_GRAVITY]) + (0.0 if extra is None else extra)
        rotation = Rotation.from_rotvec(h * self.omega).as_matrix()
        truth = None if self.truth is None else self.truth.extrapolate(c, extra)
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


class ExtraAcceleration:
    """Estimates the acceleration that neither thrust nor gravity explains, from the velocities of successive states."""

    def __init__(self) -> None:
        self._last: tuple[float, np.ndarray] | None = None
        self.value = np.zeros(3)
        """Estimate in the world frame [m/s^2]."""

    def record(self, x: VehicleState, c: float, now: float) -> None:
        """Record a state.

        Args:
            x: State as it was reported, not extrapolated.
            c: Last commanded thrust per mass [m/s^2].
            now: Time on the monotonic clock at which the state has its age [s].
        """
        stamp, last = now - x.age, self._last
        if last is not None and stamp - last[0] < SHORTEST_S:
            return
        self._last = stamp, x.v
        if last is None or stamp - last[0] > LONGEST_GAP_S:
            return
        dt = stamp - last[0]
        nominal = c * x.R[:, 2] - np.array([0.0, 0.0, STANDARD_GRAVITY])
        self.value = self.value + dt / (dt + AVERAGING_S) * ((x.v - last[1]) / dt - nominal - self.value)
        self.value = np.clip(self.value, -LARGEST, LARGEST)
