"""Trajectories of the benchmark: a circle and a lemniscate of 5 m at five mean speeds.

Each function takes no arguments, so that it can be registered by name as a reference.
"""

import math
from functools import partial

import numpy as np

from retrim.tasks.reference import Reference
from retrim.tasks.shapes import circle, figure8

RADIUS = 5.0  # [m]
SPEEDS = (2.0, 4.5, 7.0, 9.5, 12.0)
"""Mean speeds on a lap [m/s]."""


def circle_at_mean(speed: float) -> Reference:
    """Return the circle at a constant speed [m/s]."""
    return circle(RADIUS, 2.0 * math.pi * RADIUS / speed, ramp=_ramp(speed))


def lemniscate_at_mean(speed: float) -> Reference:
    """Return the lemniscate x = r cos(phi), y = r sin(phi) cos(phi) with a mean speed [m/s]; phi turns uniformly."""
    phi = np.linspace(0.0, 2.0 * math.pi, 20_001)
    length = float(np.trapezoid(RADIUS * np.hypot(np.sin(phi), np.cos(2.0 * phi)), phi))
    return figure8(2.0 * RADIUS, RADIUS, length / speed, ramp=_ramp(speed))


def _ramp(speed: float) -> float:
    """Return the duration of the smooth start [s]."""
    return max(3.0, speed)


circle_2 = partial(circle_at_mean, 2.0)
circle_4_5 = partial(circle_at_mean, 4.5)
circle_7 = partial(circle_at_mean, 7.0)
circle_9_5 = partial(circle_at_mean, 9.5)
circle_12 = partial(circle_at_mean, 12.0)
lemniscate_2 = partial(lemniscate_at_mean, 2.0)
lemniscate_4_5 = partial(lemniscate_at_mean, 4.5)
lemniscate_7 = partial(lemniscate_at_mean, 7.0)
lemniscate_9_5 = partial(lemniscate_at_mean, 9.5)
lemniscate_12 = partial(lemniscate_at_mean, 12.0)

NAMES = tuple(f"{shape}-5m-{speed:g}" for shape in ("circle", "lemniscate") for speed in SPEEDS)
"""Names of the trajectories in the registry of references."""
