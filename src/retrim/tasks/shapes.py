"""Built-in trajectories: the paper's circle, figure-8 and star, each with a smooth start from rest."""

import math
from collections.abc import Callable

from .reference import Reference

RAMP = 3.0  # [s], duration of a smooth start
SIDEWAYS = 12.0  # [m/s^2], largest acceleration at a chosen speed; shapes are enlarged to satisfy it


def smooth_start(t: float, ramp: float = RAMP) -> float:
    """Return the time along a lap that starts smoothly from rest (7th-order smooth step).

    Args:
        t: Time since take-off [s].
        ramp: Time until the full speed is reached [s].

    Returns:
        Time along the lap [s]; from ``ramp`` onwards, it is ``t - ramp / 2``.
    """
    x = min(t / ramp, 1.0)
    return ramp * (7.0 * x**5 - 14.0 * x**6 + 10.0 * x**7 - 2.5 * x**8) + max(t - ramp, 0.0)


def circle(radius: float = 1.0, period: float = 3.0, ramp: float = RAMP) -> Reference:
    """Return a horizontal circle about (radius, 0, 1) from (0, 0, 1), initially towards -y (paper, Fig. 4: 1 m, 3 s).

    Args:
        radius: Radius [m].
        period: Duration of a lap [s].
        ramp: Duration of the smooth start [s].
    """

    def path(t: float) -> list[float]:
        phi = 2.0 * math.pi * smooth_start(t, ramp) / period
        return [radius - radius * math.cos(phi), -radius * math.sin(phi), 1.0]

    return Reference.of(path, seconds=ramp + period, lap=ramp)


def figure8(length: float = 3.0, width: float = 1.0, period: float = 5.0, ramp: float = RAMP) -> Reference:
    """Return a horizontal figure-8 from (0, 0, 1) (paper, Fig. 4: 5 s).

    Args:
        length: Extent along x [m].
        width: Extent along y [m].
        period: Duration of a lap [s].
        ramp: Duration of the smooth start [s].
    """

    def path(t: float) -> list[float]:
        phi = 2.0 * math.pi * smooth_start(t, ramp) / period
        return [0.5 * length * (1.0 - math.cos(phi)), -0.5 * width * math.sin(2.0 * phi), 1.0]

    return Reference.of(path, seconds=ramp + period, lap=ramp)


def star(radius: float = 1.0, period: float = 6.0, ramp: float = RAMP) -> Reference:
    """Return a horizontal pentagram about (radius, 0, 1), from (0, 0, 1), at constant speed after the smooth start.

    Args:
        radius: Circumradius [m].
        period: Duration of a lap [s].
        ramp: Duration of the smooth start [s].
    """
    corners = [math.pi + k * math.radians(216.0) for k in range(6)]
    vertices = [(radius + radius * math.cos(a), radius * math.sin(a)) for a in corners]

    def path(t: float) -> list[float]:
        edge = 5.0 * (smooth_start(t, ramp) / period % 1.0)
        k, part = min(int(edge), 4), edge - min(int(edge), 4)
        (x0, y0), (x1, y1) = vertices[k], vertices[k + 1]
        return [x0 + part * (x1 - x0), y0 + part * (y1 - y0), 1.0]

    return Reference.of(path, seconds=ramp + period, lap=ramp)


def lissajous() -> Reference:
    """Return a horizontal 2 m x 1 m figure-8 of 5.5 s from (0, 0, 1), as in RAPTOR's flights."""
    return figure8(2.0, 1.0, 5.5)


def circle_at(speed: float) -> Reference:
    """Return a circle at ``speed`` [m/s]; the radius grows to limit the vehicle's acceleration."""
    radius = max(1.0, speed**2 / SIDEWAYS)
    return circle(radius, 2.0 * math.pi * radius / speed, ramp=max(RAMP, speed))


def figure8_at(speed: float, length: float = 3.0, width: float = 1.0) -> Reference:
    """Return a figure-8 with a given top speed; the size grows to limit the vehicle's acceleration.

    Args:
        speed: Top speed [m/s].
        length: Smallest extent along x [m].
        width: Smallest extent along y [m].
    """
    phi = [2.0 * math.pi * k / 1000 for k in range(1000)]
    fastest = max(math.hypot(0.5 * length * math.sin(p), width * math.cos(2.0 * p)) for p in phi)
    sharpest = max(math.hypot(0.5 * length * math.cos(p), 2.0 * width * math.sin(2.0 * p)) for p in phi)
    scale = max(1.0, (speed / fastest) ** 2 * sharpest / SIDEWAYS)
    period = 2.0 * math.pi * scale * fastest / speed
    return figure8(length * scale, width * scale, period, ramp=max(RAMP, speed))


def lissajous_at(speed: float) -> Reference:
    """Return :func:`lissajous` with a top speed of ``speed`` [m/s]; the size grows as in :func:`figure8_at`."""
    return figure8_at(speed, 2.0, 1.0)


def star_at(speed: float) -> Reference:
    """Return the star with a radius of 1 m at a constant ``speed`` [m/s], even at the corners."""
    edge = 2.0 * math.sin(math.radians(72.0))
    return star(1.0, 5.0 * edge / speed)


REFERENCES: dict[str, Callable[[], Reference]] = {
    "circle": circle,
    "figure8": figure8,
    "lissajous": lissajous,
    "star": star,
}
"""Factories of the built-in trajectories, by name."""
AT_SPEED: dict[str, Callable[[float], Reference]] = {
    "circle": circle_at,
    "figure8": figure8_at,
    "lissajous": lissajous_at,
    "star": star_at,
}
"""Factories of the built-in trajectories with a given top speed [m/s], by name."""
FASTEST = 20.0  # [m/s]
