"""Descriptions of the parts of a trajectory that a vehicle cannot fly."""

import numpy as np

from ..physics.state import STANDARD_GRAVITY
from ..physics.vehicle import Vehicle
from .flatness import JUMP

REST = 0.3  # [m/s]; smaller velocities are within the noise at the start of a flight
GAP = 0.02  # [m]; a lap whose ends are farther apart does not close


def unflyable(rows: np.ndarray, every: float, lap: tuple[float, float], vehicle: Vehicle) -> list[str]:
    """Compare a table with the limits of a vehicle.

    Args:
        rows: Position [m], velocity [m/s], command [m/s^2, rad/s] and heading [rad] at each instant, as in
            :class:`retrim.tasks.Reference`.
        every: Time between rows [s].
        lap: Start and end of the lap that repeats [s]; equal if the end is held.
        vehicle: Vehicle to fly the table.

    Returns:
        One sentence per reason, without a full stop; empty if the vehicle can fly the whole table.
    """
    return [
        *_not_at_rest(rows, lap),
        *_jumps(rows, every),
        *_open_lap(rows, every, lap),
        *beyond_limits(rows, every, vehicle),
        *_below_ground(rows, every),
    ]


def _not_at_rest(rows: np.ndarray, lap: tuple[float, float]) -> list[str]:
    first, final = np.linalg.norm(rows[0, 3:6]), np.linalg.norm(rows[-1, 3:6])
    result = list[str]()
    if first > REST:
        result.append(f"it starts at speed, {first:.2f} m/s, and a flight starts at rest")
    if lap[0] == lap[1] and final > REST:
        result.append(f"it ends at speed, {final:.2f} m/s, where its last point is held")
    return result


def _standing_alone(rows: np.ndarray, every: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the accelerations between rows [m/s^2], and whether each is a velocity jump."""
    accelerations = np.diff(rows[:, 3:6], axis=0) / every
    leaps = np.linalg.norm(accelerations, axis=1)
    k = np.arange(len(leaps))
    aside = np.maximum(leaps[np.maximum(k - 3, 0)], leaps[np.minimum(k + 3, len(leaps) - 1)])
    return accelerations, (leaps > JUMP) & (leaps > 3.0 * aside)


def _jumps(rows: np.ndarray, every: float) -> list[str]:
    accelerations, alone = _standing_alone(rows, every)
    if not alone.any():
        return []
    leaps = np.where(alone, np.linalg.norm(accelerations, axis=1), 0.0)
    k = int(np.argmax(leaps))
    return [f"its velocity jumps by {leaps[k] * every:.2f} m/s at {k * every:.2f} s; corners will be cut"]


def _open_lap(rows: np.ndarray, every: float, lap: tuple[float, float]) -> list[str]:
    if lap[0] == lap[1]:
        return []
    k = min(int(lap[0] / every), len(rows) - 2)
    part = lap[0] / every - k
    first = (1.0 - part) * rows[k] + part * rows[k + 1]
    gap, leap = np.linalg.norm(rows[-1, :3] - first[:3]), np.linalg.norm(rows[-1, 3:6] - first[3:6])
    if gap > GAP:
        return [f"its lap does not close: its end is {gap:.2f} m from its start"]
    slack = REST + 2.0 * np.linalg.norm(rows[k + 1, 3:6] - rows[k, 3:6])  # a corner at the seam is within a row
    return [f"its velocity jumps by {leap:.2f} m/s from lap to lap"] if leap > slack else []


def beyond_limits(rows: np.ndarray, every: float, vehicle: Vehicle) -> list[str]:
    """Return the reasons why a table exceeds a vehicle's thrust and rates; see :func:`unflyable`."""
    result = list[str]()
    accelerations, alone = _standing_alone(rows, every)
    lift = np.where(alone, np.inf, accelerations[:, 2] + STANDARD_GRAVITY)
    k = int(np.argmin(lift))
    if lift[k] < 0.0:
        down = STANDARD_GRAVITY - lift[k]
        result.append(
            f"it is steeper than free fall at {k * every:.2f} s ({down:.1f} m/s² downwards): rotors cannot push down"
        )
    c_max, rate_max = float(vehicle.command_max.c), np.asarray(vehicle.omega_max)
    i = int(np.argmax(rows[:, 6]))
    if rows[i, 6] > c_max:
        result.append(f"it needs {rows[i, 6]:.1f} m/s² of thrust at {i * every:.2f} s, the vehicle has {c_max:.1f}")
    shares = np.abs(rows[:, 7:10]) / rate_max
    j, axis = (int(index) for index in np.unravel_index(int(np.argmax(shares)), shares.shape))
    if shares[j, axis] > 1.0:
        result.append(
            f"it needs {abs(rows[j, 7 + axis]):.1f} rad/s about {'xyz'[axis]} at {j * every:.2f} s, "
            f"the limit is {rate_max[axis]:.1f}"
        )
    return result


def _below_ground(rows: np.ndarray, every: float) -> list[str]:
    k = int(np.argmin(rows[:, 2]))
    return [f"it is {-rows[k, 2]:.2f} m below the ground, z = 0, at {k * every:.2f} s"] if rows[k, 2] < -1e-3 else []
