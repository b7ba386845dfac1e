"""A reference without its own heading: the vehicle turns about its thrust axis as little as possible.

At a large tilt, a constant heading needs fast turns about the thrust axis, where the rotors have little torque. Here,
the body x axis is transported in parallel along the path of the thrust axis. On a lap, a constant rate about the thrust
axis is added, so that the attitude at its end is that at its start.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np

from .flatness import UP
from .reference import Reference


def with_free_heading(reference: Reference) -> Reference:
    """Return the reference with the heading of a vehicle that hardly turns about its thrust axis.

    Args:
        reference: Reference whose thrust always has an upward part; its heading counts at its start only.

    Returns:
        The same path in space and time. Its rows have new headings, heading rates and body rates.
    """
    rows = np.array(reference.rows, dtype=float)
    every, heading = float(reference.every), float(reference.rows[0, 10])
    thrust = rows[:, 11:14] + UP
    z = thrust / np.linalg.norm(thrust, axis=1)[:, None]
    x = _transport(z, np.array([np.cos(heading), np.sin(heading), 0.0]))
    start, end = (float(t) - float(reference.since) for t in reference.lap)
    times = every * np.arange(len(rows))
    rate = 0.0
    if start < end:
        first = int(np.ceil(start / every - 1e-6))
        rate = _angle(x[-1], x[first], z[-1]) / (times[-1] - times[first])
        x = _turn(x, z, rate * np.maximum(times - times[first], 0.0))
    nose = x[:, :2] - z[:, :2] * (x[:, 2] / z[:, 2])[:, None]
    headings = np.unwrap(np.arctan2(nose[:, 1], nose[:, 0]))
    z_dot = (rows[:, 14:17] - z * np.sum(z * rows[:, 14:17], axis=1)[:, None]) / np.linalg.norm(thrust, axis=1)[:, None]
    rows[:, 7] = -np.sum(np.cross(z, x) * z_dot, axis=1)
    rows[:, 8] = np.sum(x * z_dot, axis=1)
    rows[:, 9] = np.where(times < start, 0.0, rate) if start < end else 0.0
    rows[:, 10] = headings
    rows[:, 17] = np.gradient(headings, every)
    return dataclasses.replace(reference, rows=jnp.asarray(rows, dtype=reference.rows.dtype))


def _transport(z: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return body x axes, shape (n, 3), that the smallest rotations between thrust axes carry from ``x``."""
    result = np.empty_like(z)
    x = x - z[0] * (z[0] @ x)
    result[0] = x / np.linalg.norm(x)
    axis, zero = np.cross(z[:-1], z[1:]), np.zeros(len(z) - 1)
    cross = np.stack(
        [zero, -axis[:, 2], axis[:, 1], axis[:, 2], zero, -axis[:, 0], -axis[:, 1], axis[:, 0], zero], axis=1
    ).reshape(-1, 3, 3)
    turns = np.eye(3) + cross + cross @ cross / (1.0 + np.sum(z[:-1] * z[1:], axis=1))[:, None, None]
    for k, turn in enumerate(turns, start=1):
        x = turn @ result[k - 1]
        x = x - z[k] * (z[k] @ x)
        result[k] = x / np.sqrt(x @ x)
    return result


def _angle(before: np.ndarray, after: np.ndarray, axis: np.ndarray) -> float:
    """Return the angle about ``axis`` from one direction to another [rad]."""
    return float(np.arctan2(axis @ np.cross(before, after), before @ after))


def _turn(x: np.ndarray, z: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Return the axes ``x`` after turns about ``z`` [rad]."""
    turned_nose: np.ndarray = np.cos(angle)[:, None] * x + np.sin(angle)[:, None] * np.cross(z, x)
    return turned_nose
