"""Velocity and body rates from a series of poses."""

from collections import deque

import numpy as np

WINDOW_S = 0.06  # [s] of poses to which a parabola is fitted; shorter: more noise, longer: wrong for quick motions
LEAST_POSES, MOST_POSES = 3, 60  # poses of a fit
PARABOLA_S = 0.025  # [s] of poses from which a parabola is fitted; before, a line
SHORTEST_S = 1e-4  # [s] between two poses
LONGEST_S = 0.5  # [s] between two poses, beyond which the series begins again


class PoseVelocities:
    """Fits a parabola to the last poses; its slope at the newest pose is the velocity.

    A parabola has no delay: a first-order filter of the differences would report the velocity of 30 ms ago, and a loop
    or an identification that does not know this delay would take it for a property of the vehicle. The noise of a
    velocity is about 80 1/s times the noise of a position at 100 poses a second.
    """

    def __init__(self) -> None:
        self._poses: deque[tuple[float, np.ndarray, np.ndarray]] = deque(maxlen=MOST_POSES)
        self._last = np.zeros(3), np.zeros(3)

    def restart(self) -> None:
        """Forget the poses, for example after the sender's clock was set; the velocities stay until the next fit."""
        self._poses.clear()

    def update(self, t: float, p: np.ndarray, R: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return velocity in the world frame [m/s] and body rates [rad/s] at a new pose.

        Args:
            t: Time of the pose [s].
            p: Position in the world frame [m].
            R: Attitude, body to world.
        """
        from scipy.spatial.transform import Rotation  # local, because it takes as long to import as all of retrim

        poses = self._poses
        if poses and t - poses[-1][0] > LONGEST_S:
            poses.clear()
            self._last = np.zeros(3), np.zeros(3)
        if poses and t - poses[-1][0] < SHORTEST_S:
            return self._last
        poses.append((t, p, R))
        while len(poses) > LEAST_POSES and t - poses[0][0] > WINDOW_S:
            poses.popleft()
        if len(poses) < 2:
            return self._last
        times = np.array([each[0] - t for each in poses])
        places = np.array([each[1] - p for each in poses])
        turns = Rotation.from_matrix(np.array([R.T @ each[2] for each in poses])).as_rotvec()
        degree = 2 if len(poses) >= LEAST_POSES and -times[0] > PARABOLA_S else 1
        slope = np.linalg.pinv(np.vander(times, degree + 1, increasing=True))[1]
        self._last = slope @ places, slope @ turns
        return self._last
