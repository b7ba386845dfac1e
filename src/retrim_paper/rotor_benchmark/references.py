"""Trajectories of the benchmark: a circle and a lemniscate of 5 m at five mean speeds.

The benchmark scores positions only. The heading is therefore free, and each trajectory has the heading of a vehicle
that turns about its thrust axis as little as possible: the rotors have little torque about this axis, and a constant
heading would need up to 29 rad/s and 600 rad/s^2 there.

Each function takes no arguments, so that it can be registered by name as a reference.
"""

import math
from functools import cache, partial

import jax
import numpy as np

from retrim.tasks.free_heading import with_free_heading
from retrim.tasks.reference import Reference
from retrim.tasks.shapes import circle, figure8

RADIUS = 5.0  # [m]
SPEEDS = (2.0, 4.5, 7.0, 9.5, 12.0)
"""Mean speeds on a lap [m/s]."""
RAMP = 5.0  # [s], duration of the smooth start, so that every flight is on its lap for the second half of 10 s


def circle_at_mean(speed: float) -> Reference:
    """Return the circle at a constant speed [m/s]."""
    return _sample("circle", speed, jax.config.values["jax_enable_x64"])


def lemniscate_at_mean(speed: float) -> Reference:
    """Return the lemniscate x = r cos(phi), y = r sin(phi) cos(phi) with a mean speed [m/s]; phi turns uniformly."""
    return _sample("lemniscate", speed, jax.config.values["jax_enable_x64"])


@cache
def _sample(shape: str, speed: float, x64: bool) -> Reference:
    """Return a trajectory, sampled once per process and precision: every cell trains on all ten."""
    if shape == "circle":
        return with_free_heading(circle(RADIUS, 2.0 * math.pi * RADIUS / speed, ramp=RAMP))
    phi = np.linspace(0.0, 2.0 * math.pi, 20_001)
    length = float(np.trapezoid(RADIUS * np.hypot(np.sin(phi), np.cos(2.0 * phi)), phi))
    return with_free_heading(figure8(2.0 * RADIUS, RADIUS, length / speed, ramp=RAMP))


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
