"""Conversions between autopilot frames and our frames.

An autopilot's world frame is north, east, down (NED), and its body frame is forward, right, down (FRD). Our frames are
east, north, up (ENU) and forward, left, up (FLU), as in ROS. Each conversion is its own inverse.
"""

import numpy as np

WORLD = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
"""Matrix that converts NED to ENU, and ENU to NED."""
BODY = np.array([1.0, -1.0, -1.0])
"""Sign of each axis in the conversion from FRD to FLU, and from FLU to FRD."""


def turn_world(vector: np.ndarray) -> np.ndarray:
    """Convert a world vector to the other frame: NED to ENU, or ENU to NED."""
    out: np.ndarray = WORLD @ vector
    return out


def turn_body(vector: np.ndarray) -> np.ndarray:
    """Convert a body vector to the other frame: FRD to FLU, or FLU to FRD."""
    out: np.ndarray = BODY * vector
    return out


def turn_heading(yaw: float) -> float:
    """Convert a heading to the other frame [rad]: clockwise from north, or counter-clockwise from east."""
    return float(np.pi / 2 - yaw)


def attitude_of(q: np.ndarray) -> np.ndarray:
    """Return the attitude, body FLU to world ENU.

    Args:
        q: Quaternion w, x, y, z from body FRD to world NED, of any non-zero length.
    """
    from scipy.spatial.transform import Rotation  # local, because it takes as long to import as all of retrim

    out: np.ndarray = WORLD @ Rotation.from_quat(np.roll(q, -1)).as_matrix() * BODY
    return out


def quaternion_of(R: np.ndarray) -> np.ndarray:
    """Return an attitude in the form that autopilots send; the inverse of :func:`attitude_of` up to the sign.

    Args:
        R: Body FLU to world ENU.

    Returns:
        Unit quaternion w, x, y, z from body FRD to world NED, with w >= 0.
    """
    from scipy.spatial.transform import Rotation  # local for the same reason

    out: np.ndarray = np.roll(Rotation.from_matrix(WORLD @ R * BODY).as_quat(canonical=True), 1)
    return out


def heading_of(R: np.ndarray) -> float:
    """Return the direction of the nose, counter-clockwise from east [rad]."""
    return float(np.arctan2(R[1, 0], R[0, 0]))
