"""Trajectories to track: position, velocity, heading and the command that flies them, as functions of time.

Every reference is a table of one type, so that a policy takes it as data: another trajectory never recompiles, and one
policy can be trained over a family and fly a member that it never saw.
"""

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from ..physics.state import STANDARD_GRAVITY
from ..physics.vehicle import Vehicle

POINTS = 1024  # of a table
JUMP = 30.0  # [m/s^2]: an acceleration beyond is a jump of velocity, which no command flies
UP = np.array([0.0, 0.0, STANDARD_GRAVITY])
_STEP = 1e-3  # [s], of the differences that give velocity and acceleration

Path3 = Callable[[float], Sequence[float] | np.ndarray]
"""Time since take-off [s] -> position x, y, z [m], and heading [rad] if there is a fourth number."""


class Point(NamedTuple):
    """A reference at one instant."""

    p: Float[Array, "3"]
    """World [m]."""
    v: Float[Array, "3"]
    """World [m/s]."""
    u: Float[Array, "4"]
    """Command that a point mass needs (differential flatness): c [m/s^2], body rates [rad/s]; hover at a jump."""
    heading: Float[Array, ""]
    """[rad]"""


class Reference(eqx.Module):
    """A trajectory, sampled evenly; see :meth:`of`."""

    rows: Float[Array, "n 11"]
    """p, v, u, heading"""
    every: Float[Array, ""]
    """Time between rows [s]."""
    lap: Float[Array, "2"]
    """Start and end of the lap that repeats [s]; the same twice: the last row is held."""
    joins: Float[Array, "m 2"]
    """Spans of time in which a roll-out may start [s]; each is equally likely."""

    @classmethod
    def of(cls, path: Path3, *, seconds: float, lap: float | None = None, points: int = POINTS) -> "Reference":
        """Sample ``path`` over ``seconds``. The part from ``lap`` [s] on repeats for ever; None: the end is held.

        Raises ``ValueError``, with the time, where the path is not finite or not 3 or 4 numbers.
        """
        if not (seconds > 0 and points >= 2 and (lap is None or 0 <= lap < seconds)):
            raise ValueError(f"Reference: seconds = {seconds}, lap = {lap}, points = {points} cannot be")
        times = np.linspace(0.0, seconds, points)
        last = seconds - _STEP if lap is None else math.inf
        rows = np.array([_row(path, float(t), last) for t in times])
        ends = (seconds, seconds) if lap is None else (lap, seconds)
        joins = [(0.0, seconds)] if lap is None else [(0.0, lap), (lap, seconds), (lap, seconds)]
        return cls(jnp.asarray(rows), jnp.array(times[1]), jnp.array(ends), jnp.array(joins))

    def __call__(self, t: Float[Array, ""]) -> Point:
        """The reference at time ``t`` [s], linearly between rows."""
        start, end = self.lap[0], self.lap[1]
        length = end - start
        effects = start + (t - start) % jnp.where(length > 0, length, 1.0)
        t = jnp.where(t < end, t, jnp.where(length > 0, effects, end))
        where = jnp.clip(t / self.every, 0.0, self.rows.shape[0] - 1.0)
        i = jnp.clip(jnp.floor(where), 0, self.rows.shape[0] - 2).astype(jnp.int32)
        part = (where - i.astype(where.dtype)).astype(self.rows.dtype)
        before, after = lax.dynamic_slice_in_dim(self.rows, i, 2)  # one gather under vmap
        row = (1.0 - part) * before + part * after
        over = (length <= 0) & (t >= end)  # at rest, where the end is held
        hover = jnp.zeros(4, dtype=row.dtype).at[0].set(STANDARD_GRAVITY)
        v, u = jnp.where(over, jnp.zeros_like(row[3:6]), row[3:6]), jnp.where(over, hover, row[6:10])
        return Point(row[:3], v, u, row[10])

    def distance(self, p: Float[Array, "3"]) -> Float[Array, ""]:
        """Cross-track error: from ``p`` to the nearest row of the lap, or of the whole trajectory without one [m]."""
        times = self.every * jnp.arange(self.rows.shape[0], dtype=self.every.dtype)
        on_lap = (times >= self.lap[0] - 1e-6) | (self.lap[0] == self.lap[1])
        away = jnp.sqrt(jnp.sum((self.rows[:, :3] - p[None]) ** 2, axis=1))
        return jnp.min(jnp.where(on_lap, away, jnp.inf))

    def infeasibility(self, vehicle: Vehicle) -> str | None:
        """What the vehicle cannot fly of this, in words; None if it can fly all of it."""
        rows, times = np.asarray(self.rows), np.arange(self.rows.shape[0]) * float(self.every)
        c_max, rate_max = float(vehicle.command_max.c), np.asarray(vehicle.omega_max)
        leaps = np.linalg.norm(np.diff(rows[:, 3:6], axis=0), axis=1) / float(self.every)
        i, j = int(np.argmax(rows[:, 6])), int(np.argmax(np.max(np.abs(rows[:, 7:10]) / rate_max, axis=1)))
        k, axis = int(np.argmax(leaps)), int(np.argmax(np.abs(rows[j, 7:10]) / rate_max))
        aside = max(leaps[max(k - 3, 0)], leaps[min(k + 3, len(leaps) - 1)])  # a jump stands alone
        if leaps[k] > JUMP and leaps[k] > 3.0 * aside:
            leap = np.linalg.norm(rows[k + 1, 3:6] - rows[k, 3:6])
            return f"its velocity jumps by {leap:.2f} m/s at {times[k]:.2f} s; corners will be cut"
        if rows[i, 6] > c_max:
            return f"it needs {rows[i, 6]:.1f} m/s² of thrust at {times[i]:.2f} s, the vehicle has {c_max:.1f}"
        if abs(rows[j, 7 + axis]) > rate_max[axis]:
            rate = abs(rows[j, 7 + axis])
            return (
                f"it needs {rate:.1f} rad/s about {'xyz'[axis]} at {times[j]:.2f} s, the limit is {rate_max[axis]:.1f}"
            )
        return None


def joined(references: Sequence[Reference], *, seconds: float = 20.0, every: float = 0.02) -> Reference:
    """A family as one table, ``seconds`` of each, one after another: for roll-outs of up to 4 s."""
    if not references or seconds < 6.0:
        raise ValueError(f"joined: {len(references)} references of {seconds} s; at least 1, of at least 6 s")
    times = every * jnp.arange(round(seconds / every), dtype=float)
    rows = []
    for reference in references:
        points = jax.vmap(reference)(times)
        rows.append(jnp.concatenate([points.p, points.v, points.u, points.heading[:, None]], axis=1))
    joins = [(k * seconds, (k + 1) * seconds - 5.0) for k in range(len(references))]
    end = len(references) * seconds
    return Reference(jnp.concatenate(rows), jnp.array(every), jnp.array([end, end]), jnp.array(joins))


def smooth_start(t: float, ramp: float = 3.0) -> float:
    """Time along a lap [s] after a smooth start from rest that takes ``ramp`` seconds (7th-order smooth step)."""
    x = min(t / ramp, 1.0)
    return ramp * (7.0 * x**5 - 14.0 * x**6 + 10.0 * x**7 - 2.5 * x**8) + max(t - ramp, 0.0)


def circle(radius: float = 1.0, period: float = 3.0, ramp: float = 3.0) -> Reference:
    """Horizontal, through (0, 0, 1), about (radius, 0, 1); first towards -y (paper, Fig. 4: 1 m, 3 s)."""

    def path(t: float) -> list[float]:
        phi = 2.0 * math.pi * smooth_start(t, ramp) / period
        return [radius - radius * math.cos(phi), -radius * math.sin(phi), 1.0]

    return Reference.of(path, seconds=ramp + period, lap=ramp)


def figure8(length: float = 3.0, width: float = 1.0, period: float = 5.0, ramp: float = 3.0) -> Reference:
    """Horizontal, ``length`` x ``width``, from (0, 0, 1) (paper, Fig. 4: 5 s)."""

    def path(t: float) -> list[float]:
        phi = 2.0 * math.pi * smooth_start(t, ramp) / period
        return [0.5 * length * (1.0 - math.cos(phi)), -0.5 * width * math.sin(2.0 * phi), 1.0]

    return Reference.of(path, seconds=ramp + period, lap=ramp)


def star(radius: float = 1.0, period: float = 6.0, ramp: float = 3.0) -> Reference:
    """A pentagram of that circumradius about (radius, 0, 1), from (0, 0, 1), at constant speed once it is spun up."""
    corners = [math.pi + k * math.radians(216.0) for k in range(6)]
    vertices = [(radius + radius * math.cos(a), radius * math.sin(a)) for a in corners]

    def path(t: float) -> list[float]:
        edge = 5.0 * (smooth_start(t, ramp) / period % 1.0)
        k, part = min(int(edge), 4), edge - min(int(edge), 4)
        (x0, y0), (x1, y1) = vertices[k], vertices[k + 1]
        return [x0 + part * (x1 - x0), y0 + part * (y1 - y0), 1.0]

    return Reference.of(path, seconds=ramp + period, lap=ramp)


REFERENCES: dict[str, Callable[[], Reference]] = {"circle": circle, "figure8": figure8, "star": star}


def from_csv(file: Path) -> Reference:
    """A reference through the points of a CSV file with columns t, x, y, z and, if wanted, yaw ([s], [m], [rad]).

    A cubic spline, starting and ending at rest; a header line, whose first word starts with t, is skipped. Raises
    ``ValueError`` with the line for what is not a number, for times that do not rise, and for fewer than two points.
    """
    rows = list[list[float]]()
    for number, line in enumerate(file.read_text(encoding="utf-8-sig").splitlines(), start=1):
        words = [word.strip() for word in line.split(",")]
        if not line.strip() or (not rows and words[0].lower().startswith("t")):
            continue
        try:
            row = [float(word) for word in words]
        except ValueError as error:
            raise ValueError(f"{file}, line {number}: {line!r} is not t, x, y, z[, yaw] in numbers") from error
        if len(row) not in (4, 5) or (rows and len(row) != len(rows[0])) or not all(map(math.isfinite, row)):
            raise ValueError(f"{file}, line {number}: {line!r} is not t, x, y, z[, yaw], as finite numbers")
        if rows and row[0] <= rows[-1][0]:
            raise ValueError(f"{file}, line {number}: time {row[0]} s does not come after {rows[-1][0]} s")
        rows.append(row)
    if len(rows) < 2:
        raise ValueError(f"{file}: {len(rows)} points; a trajectory needs at least two")
    from scipy.interpolate import CubicSpline  # here: it takes as long to import as all of retrim

    table = np.array(rows)
    spline = CubicSpline(table[:, 0] - table[0, 0], table[:, 1:], bc_type="clamped")
    return Reference.of(lambda t: spline(t), seconds=float(table[-1, 0] - table[0, 0]))


def _row(path: Path3, t: float, last: float) -> np.ndarray:
    """p, v, u and heading at ``t``, by central differences inside [0, last]."""
    h = _STEP

    def at(t: float) -> np.ndarray:
        point = np.asarray(path(t), dtype=float)
        if point.shape not in ((3,), (4,)) or not np.all(np.isfinite(point)):
            raise ValueError(f"Reference: at {t:g} s the path gives {point}, not 3 or 4 finite numbers")
        return np.append(point, 0.0)[:4]

    middle = min(max(t, 2.0 * h), last - h)
    effects = [at(middle + k * h) for k in range(-2, 3)]
    v = (effects[3] - effects[1])[:3] / (2.0 * h)
    pulls = [(effects[k + 1] - 2.0 * effects[k] + effects[k - 1])[:3] / h**2 for k in (1, 2, 3)]
    p = at(t)
    fine = (at(middle + 0.1 * h) - 2.0 * effects[2] + at(middle - 0.1 * h))[:3] / (0.1 * h) ** 2
    if max(np.linalg.norm(a - fine) for a in pulls) > JUMP:  # a jump does not look the same from nearer
        return np.concatenate([p[:3], v, [STANDARD_GRAVITY, 0.0, 0.0, 0.0], p[3:]])
    R_before, R, R_after = (_attitude(a, here[3]) for a, here in zip(pulls, effects[1:4], strict=True))
    turn = R.T @ (R_after - R_before) / (2.0 * h)
    return np.concatenate([p[:3], v, [np.linalg.norm(pulls[1] + UP), turn[2, 1], turn[0, 2], turn[1, 0]], p[3:]])


def _attitude(a: np.ndarray, heading: float) -> np.ndarray:
    """Body axes as columns: z along the thrust that the acceleration ``a`` needs, x towards the heading."""
    z = (a + UP) / np.linalg.norm(a + UP)
    y = np.cross(z, [math.cos(heading), math.sin(heading), 0.0])
    y = y / np.linalg.norm(y)
    return np.stack([np.cross(y, z), y, z], axis=1)
