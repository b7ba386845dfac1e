"""Converts the attitudes in a log to rotation matrices."""

from pathlib import Path

import numpy as np

from ...errors import LogError
from .log_map import ANGLES, Attitude

COLUMNS = {"xyzw": 4, "wxyz": 4, "matrix": 9, "roll pitch yaw": 3, "rotation vector": 3}
NORM_TOLERANCE = 0.05  # tolerance for the norm of a quaternion, and for orthogonality (also added to the angle limit)
MOST_OUTSIDE = 0.01  # accepted share of samples outside the tolerance; these are left out


def attitudes(values: np.ndarray, spec: Attitude, path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return rotation matrices, (n, 3, 3), body to world in the log's frames, and a mask of valid rotations.

    Raises:
        LogError: The numbers cannot be attitudes in this form.
    """
    from scipy.spatial.transform import Rotation  # local, because it takes as long to import as all of retrim

    if values.shape[1] != COLUMNS[spec.form]:
        raise LogError(
            f"{path}: attitude: form {spec.form!r} needs {COLUMNS[spec.form]} numbers, the fields hold "
            f"{values.shape[1]}"
        )
    if spec.form == "rotation vector":
        rotation, good = Rotation.from_rotvec(ANGLES[spec.unit] * values), np.ones(len(values), dtype=bool)
    elif spec.form == "roll pitch yaw":
        angles = ANGLES[spec.unit] * values
        if np.abs(angles).max() > 2.0 * np.pi + NORM_TOLERANCE:
            raise LogError(
                f"{path}: attitude: angles reach {np.abs(values).max():.4g} {spec.unit}; "
                + ("are they in deg?" if spec.unit == "rad" else "no attitude exceeds a turn")
            )
        rotation = Rotation.from_euler("ZYX", angles[:, ::-1])
        good = np.ones(len(values), dtype=bool)
    elif spec.form == "matrix":
        R = values.reshape(-1, 3, 3)
        off = np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3)).max(axis=(1, 2))
        good = _mostly(off < NORM_TOLERANCE, path, "matrices", "orthogonal")
        if np.median(np.linalg.det(R)) < 0.0:
            raise LogError(f"{path}: attitude: the matrices are reflections, not rotations: an axis has the wrong sign")
        rotation = Rotation.from_matrix(np.where(good[:, None, None], R, np.eye(3)))
    else:
        norm = np.linalg.norm(values, axis=1)
        good = _mostly(np.abs(norm - 1.0) < NORM_TOLERANCE, path, "quaternions", "of norm one")
        order = values if spec.form == "xyzw" else np.roll(values, -1, axis=1)
        rotation = Rotation.from_quat(np.where(good[:, None], order, [0.0, 0.0, 0.0, 1.0]))
    if spec.turns == "world to body":
        rotation = rotation.inv()
    return np.asarray(rotation.as_matrix()), good


def _mostly(good: np.ndarray, path: Path, what: str, right: str) -> np.ndarray:
    if np.mean(~good) > MOST_OUTSIDE:
        raise LogError(
            f"{path}: attitude: {100 * np.mean(~good):.0f} % of the {what} are not {right}; are these the right fields?"
        )
    return good
