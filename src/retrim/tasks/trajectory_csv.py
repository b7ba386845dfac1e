"""References through the points of a file: repeating laps, or a single path whose end is held."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import ConfigError
from ..physics.state import STANDARD_GRAVITY
from .feasibility import REST
from .reference import POINTS, Reference
from .shapes import RAMP, smooth_start
from .trajectory_table import read_table

CLOSURE = 0.01  # [m]; ends closer than this coincide
CLOSED_YAW = 0.02  # [rad]
SHORTEST_LAP = 0.5  # [s]
VELOCITY_TOLERANCE = 0.1  # share of the speed by which the velocities of two passes of one lap may differ
ROW = 0.02  # [s], largest time between rows
LONG = 3.0  # an interval this many times as long as a neighbour may be a wait
STEEP = 3.0  # a cubic whose ends are steeper than this, in units of its mean slope, can overshoot (Fritsch, Carlson)
LEVEL = 0.01  # [m], [rad]; motion during an interval that is too small to overshoot visibly
PASSES = 4  # an overshoot that is removed can reveal a smaller one beside it
EXTRA_POINTS = 12  # points added beyond a lap's end, since the end of a spline affects about that many points


def from_csv(file: Path, laps: bool | None = None) -> Reference:
    """Return a cubic-spline reference through the points of a file.

    A file is closed if its last point is within 1 cm of its first and has the same yaw, up to whole turns. A closed
    file repeats as laps. A file that ends in motion at an earlier point on its path, in the same direction and at the
    same speed, repeats from that point. Laps that start in motion begin with a smooth start of 3 s along the path, like
    the built-in shapes. Any other file is flown once, from rest to rest, and its end is held. If the points at an end
    are too close together for a vehicle to stop between them, the reference remains in motion at that end, and
    :meth:`Reference.infeasibility` reports it.

    In an interval that is much longer than its neighbours, the path waits or flies straight on if the spline would
    overshoot there.

    Args:
        file: Times, positions and headings; see :func:`retrim.tasks.trajectory_table.read_table` for the format.
        laps: True requires laps, False flies any file once, and None decides from the ends of the file.

    Returns:
        The reference, with rows at most 20 ms apart. Time 0 is the time of the first point.

    Raises:
        ConfigError: The file cannot be used (the message contains the line), or ``laps`` is true and the file does not
            repeat.
        OSError: The file cannot be opened.
    """
    table = read_table(Path(file))
    start = None if laps is False else _lap_start(table)
    if start is not None:
        return _repeat(table, start)
    if laps:
        raise ConfigError(f"{file}: {_why_no_lap(table)}; a lap ends with the point that it starts with")
    return _once(table)


def _once(table: np.ndarray) -> Reference:
    seconds = float(table[-1, 0])
    spline = _spline(table, (_end(table, 0), _end(table, -1)))
    return Reference.of(spline, seconds=seconds, points=_points(seconds))


def _repeat(table: np.ndarray, start: float) -> Reference:
    """Return a reference that follows the whole table once, and then repeats the part from ``start`` [s] on."""
    period = float(table[-1, 0]) - start
    spline, winding = _lap_spline(table, start)
    in_motion = float(np.linalg.norm((spline(1e-3) - spline(0.0))[:3])) / 1e-3 > REST

    def path(t: float) -> np.ndarray:
        s = smooth_start(t) if in_motion else t
        turns = max(math.floor((s - start) / period), 0)
        return np.asarray(spline(s - turns * period) + turns * winding)

    lap = max(start + 0.5 * RAMP, RAMP) if in_motion else start
    return Reference.of(path, seconds=lap + period, lap=lap, points=_points(lap + period))


def _lap_spline(table: np.ndarray, start: float) -> tuple[Callable[[float], np.ndarray], np.ndarray]:
    """Return a spline that is smooth between laps, and its change per lap, which consists of whole turns of yaw."""
    table, period = table.copy(), float(table[-1, 0]) - start
    first = table[0, 1:] if start == 0.0 else _spline(table, (_end(table, 0), "not-a-knot"))(start)
    winding = np.array([0.0, 0.0, 0.0, 2.0 * math.pi * round((table[-1, 4] - first[3]) / (2.0 * math.pi))])
    along = np.clip((table[:, 0] - start) / period, 0.0, None)[:, None]
    table[:, 1:] += along * (first + winding - table[-1, 1:])  # spread the gap over all points: no step at the seam
    if start == 0.0:
        turning = winding / period
        table[:, 1:] -= table[:, :1] * turning
        table[-1, 1:] = table[0, 1:]
        periodic = _spline(table, "periodic")
        return (lambda t: periodic(t) + t * turning), winding
    after = table[table[:, 0] > start + 0.1 * (table[-1, 0] - table[-2, 0])][:EXTRA_POINTS].copy()
    after[:, 0] += period
    after[:, 1:] += winding
    return _spline(np.concatenate([table, after]), (_end(table, 0), "not-a-knot")), winding


def _lap_start(table: np.ndarray) -> float | None:
    """Return the time [s] from which the table can repeat: 0 for a closed table, None if it cannot repeat."""
    if len(table) < 4:
        return None
    if _ends_meet(table) and _end(table, 0) == _end(table, -1):
        return 0.0
    if _end(table, -1) == "clamped":
        return None
    from scipy.optimize import minimize_scalar  # local, because it takes as long to import as all of retrim

    spline, end, last = _spline(table, (_end(table, 0), "not-a-knot")), float(table[-1, 0]), table[-1, 1:]
    times = np.linspace(0.0, end, 8 * len(table))
    far = np.linalg.norm(spline(times)[:, :3] - last[:3], axis=1)
    nearest = 1 + np.flatnonzero((far[1:-1] <= far[:-2]) & (far[1:-1] <= far[2:]))
    v_end = spline(end, 1)[:3]
    for k in reversed(nearest):
        if times[k] > end - SHORTEST_LAP or np.sum(table[:, 0] > times[k]) < 4:
            continue
        t = minimize_scalar(
            lambda t: float(np.sum((spline(t)[:3] - last[:3]) ** 2)),
            bounds=(times[k - 1], times[k + 1]),
            method="bounded",
            options={"xatol": 1e-9},
        ).x
        as_fast = np.linalg.norm(spline(t, 1)[:3] - v_end) <= VELOCITY_TOLERANCE * np.linalg.norm(v_end)
        if as_fast and _same(spline(t), last):
            return float(t)
    return None


def _why_no_lap(table: np.ndarray) -> str:
    gap = float(np.linalg.norm(table[-1, 1:4] - table[0, 1:4]))
    if len(table) < 4:
        return f"{len(table)} points; a lap needs at least four"
    if gap > CLOSURE:
        return f"its last point is {gap:.3f} m from its first"
    if not _ends_meet(table):
        return "its last point is where its first is, but with another yaw"
    return "it rests at one of its ends and moves at the other"


def _ends_meet(table: np.ndarray) -> bool:
    return _same(table[0, 1:], table[-1, 1:])


def _same(a: np.ndarray, b: np.ndarray) -> bool:
    near = bool(np.linalg.norm(a[:3] - b[:3]) <= CLOSURE)
    return near and abs(math.remainder(a[3] - b[3], 2.0 * math.pi)) <= CLOSED_YAW


def _end(table: np.ndarray, which: int) -> str:
    """Return the boundary condition at an end of a spline: rest, or motion if a vehicle cannot stop between points."""
    near = table[:4] if which == 0 else table[-4:]
    at, beside = near[which, 0], near[1 if which == 0 else -2, 0]
    speed = float(np.linalg.norm(_spline(near, "not-a-knot")(at, 1)[:3]))
    return "not-a-knot" if speed > REST and speed / abs(beside - at) > STANDARD_GRAVITY else "clamped"


def _spline(table: np.ndarray, ends: str | tuple[str, str]) -> Any:
    """Return a spline through the points, with straight lines in the intervals in which it would overshoot."""
    from scipy.interpolate import CubicSpline  # local, because it takes as long to import as all of retrim

    spline = CubicSpline(table[:, 0], table[:, 1:], bc_type=ends)
    for _ in range(PASSES):
        added = _wait_points(table, spline, periodic=ends == "periodic")
        if len(added) == 0:
            break
        table = np.concatenate([table, added])
        table = table[np.argsort(table[:, 0], kind="stable")]
        spline = CubicSpline(table[:, 0], table[:, 1:], bc_type=ends)
    return spline


def _wait_points(table: np.ndarray, spline: Any, *, periodic: bool) -> np.ndarray:
    """Return points to add where the spline overshoots, because an interval is much longer than its neighbours.

    The position, the heading or both are on the straight line between the points of the interval.
    """
    times = table[:, 0]
    steps, slopes = np.diff(times), spline(times, 1)
    before, after = np.roll(steps, 1), np.roll(steps, -1)
    if not periodic:
        before[0] = after[-1] = np.inf
    added = [np.empty((0, table.shape[1]))]
    for k in np.flatnonzero(steps > LONG * np.minimum(before, after)):
        change = table[k + 1, 1:] - table[k, 1:]
        straight = [
            column
            for part in (slice(0, 3), slice(3, 4))
            if steps[k] * np.linalg.norm(slopes[k : k + 2, part], axis=1).max()
            > STEEP * np.linalg.norm(change[part]) + LEVEL
            for column in range(part.start, part.stop)
        ]
        if straight:
            t = times[k] + _wait_times(steps[k], before[k], after[k])
            points = np.column_stack([t, spline(t)])
            line = table[k, 1:] + ((t - times[k]) / steps[k])[:, None] * change
            points[:, [1 + column for column in straight]] = line[:, straight]
            added.append(points)
    return np.concatenate(added)


def _wait_times(length: float, before: float, after: float) -> np.ndarray:
    """Return times within a long interval [s] whose distances double towards its middle."""
    halves = []
    for step in (before, after):
        n = math.floor(math.log2(0.4 * length / step + 1.0))
        halves.append(step * (2.0 ** np.arange(1, n + 1) - 1.0))
    return np.unique(np.concatenate([halves[0], length - halves[1]]))


def _points(seconds: float) -> int:
    """Return a sufficient number of rows, which is a multiple of the number in the built-in shapes."""
    return POINTS * math.ceil(seconds / (ROW * (POINTS - 1)))
