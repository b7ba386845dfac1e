"""Converts one thrust command, or one command for each motor, to the collective thrust in the map's unit."""

import math

import numpy as np

from .log_map import Thrust


def collective_of(spec: Thrust, columns: np.ndarray) -> np.ndarray:
    """Return the upward thrust of a row of commands: for a share, the share of full thrust.

    Args:
        spec: The map's thrust.
        columns: One column, or one for each motor, (n, motors).

    Returns:
        Mean over the motors, (n,); the sum over the motors for the unit N.
    """
    columns = spec.sign * columns
    if spec.unit != "share":
        return np.asarray(columns.sum(axis=1) if spec.unit == "N" else columns.mean(axis=1))
    return np.asarray(share_of(spec, columns).mean(axis=1))


def share_of(spec: Thrust, numbers: np.ndarray) -> np.ndarray:
    """Return the share of full thrust that numbers on the log's scale mean; negative numbers keep their sign."""
    shares = (numbers - spec.zero) / (spec.full - spec.zero)
    return np.asarray((1.0 - spec.curve) * shares + spec.curve * shares * np.abs(shares))


def number_of(spec: Thrust, share: float) -> float:
    """Return the number on the log's scale that means a share of full thrust; the inverse of :func:`share_of`."""
    e = spec.curve
    command = share if e == 0.0 else (math.sqrt((1.0 - e) ** 2 + 4.0 * e * max(share, 0.0)) - (1.0 - e)) / (2.0 * e)
    return spec.zero + command * (spec.full - spec.zero)
