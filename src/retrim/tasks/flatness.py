"""Differential flatness: from a path in space to the velocity, command and heading of a point mass that follows it."""

import math
from collections.abc import Callable, Sequence

import numpy as np

from ..physics.state import STANDARD_GRAVITY

Path3 = Callable[[float], Sequence[float] | np.ndarray]
"""Time since take-off [s] -> position x, y, z [m], and heading [rad] if there is a fourth number."""

JUMP = 30.0  # [m/s^2]: an acceleration beyond is a jump of velocity, which no command flies
STEP = 1e-3  # [s], of the differences that give velocity and acceleration
NO_THRUST = 1e-3  # [m/s^2]: a smaller thrust has no direction, and the attitude is undefined
UP = np.array([0.0, 0.0, STANDARD_GRAVITY])


def flat_row(path: Path3, t: float, last: float) -> np.ndarray:
    """Differentiate a path at one instant, by central differences inside [0, ``last``].

    Where the velocity jumps, and where the attitude is undefined (free fall, or a nose that would point along the
    thrust), the command is that of hover.

    Args:
        path: Position, world [m], and heading [rad] if wanted, by time [s].
        t: When [s].
        last: End of what may be evaluated [s]; infinite for a path that repeats.

    Returns:
        Eleven numbers: position [m] and velocity [m/s] in the world frame, collective thrust [m/s^2], body rates
        [rad/s] in the body frame, heading [rad].

    Raises:
        ValueError: The path does not give 3 or 4 finite numbers.
    """
    h = STEP

    def at(t: float) -> np.ndarray:
        point = np.asarray(path(t), dtype=float)
        if point.shape not in ((3,), (4,)) or not np.all(np.isfinite(point)):
            raise ValueError(f"Reference: at {t:g} s the path gives {point}, not 3 or 4 finite numbers")
        return np.append(point, 0.0)[:4]

    middle = min(max(t, 2.0 * h), last - h)
    points = [at(middle + k * h) for k in range(-2, 3)]
    v = (points[3] - points[1])[:3] / (2.0 * h)
    accelerations = [(points[k + 1] - 2.0 * points[k] + points[k - 1])[:3] / h**2 for k in (1, 2, 3)]
    here = at(t)
    hover = np.concatenate([here[:3], v, [STANDARD_GRAVITY, 0.0, 0.0, 0.0], here[3:]])
    closer = (at(middle + 0.1 * h) - 2.0 * points[2] + at(middle - 0.1 * h))[:3] / (0.1 * h) ** 2
    if max(np.linalg.norm(a - closer) for a in accelerations) > JUMP:  # a jump does not look the same from nearer
        return hover
    R_before, R, R_after = (_attitude(a, point[3]) for a, point in zip(accelerations, points[1:4], strict=True))
    if R_before is None or R is None or R_after is None:
        return hover
    turn = R.T @ (R_after - R_before) / (2.0 * h)
    thrust = np.linalg.norm(accelerations[1] + UP)
    return np.concatenate([here[:3], v, [thrust, turn[2, 1], turn[0, 2], turn[1, 0]], here[3:]])


def _attitude(a: np.ndarray, heading: float) -> np.ndarray | None:
    """Return body axes as columns: z along the thrust that the acceleration ``a`` needs, x towards the heading."""
    if np.linalg.norm(a + UP) < NO_THRUST:
        return None
    z = (a + UP) / np.linalg.norm(a + UP)
    y = np.cross(z, [math.cos(heading), math.sin(heading), 0.0])
    if np.linalg.norm(y) < NO_THRUST:
        return None
    y = y / np.linalg.norm(y)
    return np.stack([np.cross(y, z), y, z], axis=1)
