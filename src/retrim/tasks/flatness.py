"""Differential flatness: from a path in space to the velocity, command and heading of a point mass that follows it."""

import math
from collections.abc import Callable, Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..physics.state import STANDARD_GRAVITY

Path3 = Callable[[float], Sequence[float] | np.ndarray]
"""Function from time since take-off [s] to position x, y, z [m] and, as an optional fourth number, heading [rad]."""

JUMP = 30.0  # [m/s^2]; a larger acceleration is treated as a velocity jump, which cannot be flown
STEP = 1e-3  # [s], step of the finite differences for velocity and acceleration
NO_THRUST = 1e-3  # [m/s^2]; for a smaller thrust the attitude is undefined
UP = np.array([0.0, 0.0, STANDARD_GRAVITY])
FULL_TURN = 2.0 * math.pi  # [rad]; headings that differ by this angle are the same


def flat_rows(path: Path3, times: np.ndarray, last: float) -> np.ndarray:
    """Differentiate a path at many instants, by central differences within [0, ``last``].

    The command is hover where the velocity jumps or the attitude is undefined (in free fall, or if the nose would point
    along the thrust).

    Args:
        path: Function from time [s] to world position [m] and, optionally, heading [rad], which may jump by whole
            turns.
        times: Instants [s], shape (n,).
        last: End of the range in which the path is defined [s]; infinite for a repeating path.

    Returns:
        Eighteen numbers for each instant, shape (n, 18): position [m] and velocity [m/s] in the world frame, collective
        thrust [m/s^2], body rates [rad/s] in the body frame, unwrapped heading [rad], acceleration [m/s^2] and jerk
        [m/s^3] in the world frame, and heading rate [rad/s]. The last seven are zero where the command is hover.

    Raises:
        ValueError: The path does not return 3 or 4 finite numbers.
    """
    h = STEP
    here = _points(path, times)
    middle = np.minimum(np.maximum(times, 2.0 * h), last - h)
    around = [_points(path, middle + k * h) for k in range(-2, 3)]
    near = [_points(path, middle + k * h) for k in (0.1, -0.1)]
    v = (around[3] - around[1])[:, :3] / (2.0 * h)
    accelerations = [(around[k + 1] - 2.0 * around[k] + around[k - 1])[:, :3] / h**2 for k in (1, 2, 3)]
    closer = (near[0] - 2.0 * around[2] + near[1])[:, :3] / (0.1 * h) ** 2
    # At a jump, the finite differences depend on the step.
    jumps = np.max([np.linalg.norm(a - closer, axis=1) for a in accelerations], axis=0) > JUMP
    frames = [_attitudes(a, point[:, 3]) for a, point in zip(accelerations, around[1:4], strict=True)]
    (R_before, before), (R, now), (R_after, after) = frames
    turn = np.swapaxes(R, 1, 2) @ (R_after - R_before) / (2.0 * h)
    thrust = np.linalg.norm(accelerations[1] + UP, axis=1)
    inputs = np.stack([thrust, turn[:, 2, 1], turn[:, 0, 2], turn[:, 1, 0]], axis=1)
    hover = np.array([STANDARD_GRAVITY, 0.0, 0.0, 0.0])
    is_defined = (before & now & after & ~jumps)[:, None]
    u = np.where(is_defined, inputs, hover)
    jerk = (accelerations[2] - accelerations[0]) / (2.0 * h)
    heading_change = (around[3] - around[1])[:, 3:]
    heading_rate = (heading_change - FULL_TURN * np.round(heading_change / FULL_TURN)) / (2.0 * h)
    moving = np.where(is_defined, np.concatenate([accelerations[1], jerk, heading_rate], axis=1), 0.0)
    # Tables are interpolated, so the heading between two rows that differ by a turn would be arbitrary.
    return np.concatenate([here[:, :3], v, u, np.unwrap(here[:, 3:], axis=0), moving], axis=1)


def flat_command(
    thrust: Float[Array, "3"], jerk: Float[Array, "3"], heading: Float[Array, ""], heading_rate: Float[Array, ""]
) -> Float[Array, "4"]:
    """Return the command that a point mass needs at one instant.

    Args:
        thrust: Required mass-normalised thrust, a vector that is neither zero nor horizontal [m/s^2].
        jerk: Rate of change of the thrust [m/s^3].
        heading: Direction of the nose [rad].
        heading_rate: Heading rate [rad/s].

    Returns:
        Collective thrust [m/s^2] and body rates [rad/s].
    """
    c = jnp.sqrt(jnp.sum(thrust * thrust))
    z = thrust / c
    z_dot = (jerk - z * jnp.sum(z * jerk)) / c
    nose = jnp.stack([jnp.cos(heading), jnp.sin(heading), jnp.zeros_like(heading)])
    nose_dot = heading_rate * jnp.stack([-jnp.sin(heading), jnp.cos(heading), jnp.zeros_like(heading)])
    sideways = jnp.cross(z, nose)
    length = jnp.sqrt(jnp.sum(sideways * sideways))
    y = sideways / length
    x = jnp.cross(y, z)
    turn = -jnp.sum(x * (jnp.cross(z_dot, nose) + jnp.cross(z, nose_dot))) / length
    return jnp.stack([c, -jnp.sum(y * z_dot), jnp.sum(x * z_dot), turn])


def _points(path: Path3, times: np.ndarray) -> np.ndarray:
    """Evaluate a path: x, y, z and heading at each instant."""
    rows = np.zeros((len(times), 4))
    for row, t in zip(rows, times.tolist(), strict=True):
        point = np.asarray(path(t), dtype=float)
        if point.shape not in ((3,), (4,)) or not np.isfinite(point).all():
            raise ValueError(f"Reference: at {t:g} s the path gives {point}, not 3 or 4 finite numbers")
        row[: len(point)] = point
    return rows


def _attitudes(a: np.ndarray, heading: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the body axes for each acceleration as columns: z along the thrust, x towards the heading.

    The second array is true where the axes are defined.
    """
    thrust = np.linalg.norm(a + UP, axis=1)
    z = (a + UP) / np.maximum(thrust, NO_THRUST)[:, None]
    y = np.cross(z, np.stack([np.cos(heading), np.sin(heading), np.zeros_like(heading)], axis=1))
    sideways = np.linalg.norm(y, axis=1)
    y = y / np.maximum(sideways, NO_THRUST)[:, None]
    return np.stack([np.cross(y, z), y, z], axis=2), (thrust >= NO_THRUST) & (sideways >= NO_THRUST)
