"""Frames of autopilots and ours.

An autopilot's world is north, east, down (NED) and its body forward, right, down (FRD); ours are east, north, up (ENU)
and forward, left, up (FLU), as in ROS. Each change of frame is its own inverse.
"""

import numpy as np

WORLD = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
"""NED to ENU, and ENU to NED."""
BODY = np.array([1.0, -1.0, -1.0])
"""FRD to FLU, and FLU to FRD, by axis."""


def turned_world(vector: np.ndarray) -> np.ndarray:
    """Return a world vector of the other frame: NED for ENU, ENU for NED."""
    out: np.ndarray = WORLD @ vector
    return out


def turned_body(vector: np.ndarray) -> np.ndarray:
    """Return a body vector of the other frame: FRD for FLU, FLU for FRD."""
    out: np.ndarray = BODY * vector
    return out


def turned_heading(yaw: float) -> float:
    """Return a heading of the other frame [rad]: from north clockwise, or from east counter-clockwise."""
    return float(np.pi / 2 - yaw)


def attitude_of(q: np.ndarray) -> np.ndarray:
    """Return the attitude, body FLU to world ENU.

    Args:
        q: Quaternion w, x, y, z, body FRD to world NED; of any non-zero length.
    """
    from scipy.spatial.transform import Rotation  # local, because it takes as long to import as all of retrim

    out: np.ndarray = WORLD @ Rotation.from_quat(np.roll(q, -1)).as_matrix() * BODY
    return out


def quaternion_of(R: np.ndarray) -> np.ndarray:
    """Return an attitude in the form that autopilots send; the inverse of :func:`attitude_of` up to the sign.

    Args:
        R: Body FLU to world ENU.

    Returns:
        Unit quaternion w, x, y, z, body FRD to world NED, w >= 0.
    """
    from scipy.spatial.transform import Rotation  # local for the same reason

    out: np.ndarray = np.roll(Rotation.from_matrix(WORLD @ R * BODY).as_quat(canonical=True), 1)
    return out


def heading_of(R: np.ndarray) -> float:
    """Return the direction of the nose, from east counter-clockwise [rad]."""
    return float(np.arctan2(R[1, 0], R[0, 0]))
