"""Applies a map to series, and gives states and commands on one clock, in retrim's frames and units."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ...errors import LogError
from ...physics.state import STANDARD_GRAVITY
from . import log_map as maps
from .attitudes import attitudes
from .axes import to_body, to_world
from .collective import collective_of, share_of
from .log_map import LogMap
from .resampling import (
    around,
    derivative,
    hold_last,
    interpolate,
    interpolate_attitudes,
    mark_known,
    mean_of_steps,
    period,
)
from .series import Series

UP = np.array([0.0, 0.0, STANDARD_GRAVITY])
STATES = ("position", "velocity", "attitude")
LONGEST_TICK = 0.1  # [s]: slower states do not determine accelerations, and no preset has such a tick
SHORTEST = 2e-5  # [s]: states never arrive that often
ROUNDING = 0.045  # relative deviation of a logger that is set to ten samples per second
LONGEST = 5_000_000  # maximum number of ticks
LONGEST_PAUSE, PAUSE_END = 12.0, 5.0  # [s]: of a longer pause, only this long an end to each side has ticks
MOTORS = 4  # smallest number of motors
PERIOD_TOLERANCE = 0.02  # relative difference up to which the log's period and the control period count as equal
SAMPLED_SHARE = 0.95  # share of ticks with a sample; single samples may have been left out
COMMAND_HELD = 0.5  # [s]: some autopilots publish a command only when it changes


@dataclass(frozen=True)
class Ticks:
    """A log on one clock, with world axes east-north-up and body axes forward-left-up."""

    t: np.ndarray
    p: np.ndarray
    R: np.ndarray
    v: np.ndarray
    a: np.ndarray
    rates: np.ndarray
    thrust: np.ndarray
    """Upward thrust in the map's unit; a share is not converted."""
    command: np.ndarray | None
    known: np.ndarray
    """Ticks at which all quantities are known."""
    hover: np.ndarray | None
    dt: float
    gyroscope: bool
    """Whether the rates are measured rather than derived from the attitudes."""


@dataclass(frozen=True)
class Grid:
    """The common clock of a log."""

    t: np.ndarray
    dt: float
    sampled: bool
    """Whether the grid's times are the original times of the states."""

    @property
    def log_time(self) -> np.ndarray:
        """Times from the first tick [s], in which the part of a pause without ticks lasts one tick."""
        steps = np.diff(self.t)
        pauses = np.where(steps > 2.0 * self.dt, steps - self.dt, 0.0)
        return np.asarray(self.t - self.t[0] - np.concatenate([[0.0], np.cumsum(pauses)]))


def grid_of(path: Path, series: dict[str, Series], part: maps.Part, dt: float) -> Grid:
    """Return the clock on which a log is read.

    Raises:
        LogError: States arrive too rarely, or the quantities do not overlap in time.
    """
    states = [name for name in STATES if name in series]
    own = max(period(series[name]) for name in states)
    slowest = max(states, key=lambda name: period(series[name]))
    if own > (1.0 + ROUNDING) * LONGEST_TICK:
        remedy = "is time in ms or us?" if own > 5.0 else "log it at 50 Hz (PX4: SDLOG_PROFILE with high rate)"
        raise LogError(
            f"{path}: {slowest} comes every {own:.3g} s; accelerations need a sample every "
            f"{LONGEST_TICK:g} s at least; {remedy}"
        )
    if own < SHORTEST:
        raise LogError(f"{path}: {slowest} comes every {own:.3g} s; is time in ms, us or ns?")
    required = {name: each for name, each in series.items() if " " not in name}  # marks also hold before and after
    zero = min(each.t[0] for each in required.values())
    first = max(max(each.t[0] for each in required.values()), zero + part.start)
    last = min(min(series[name].t[-1] for name in states), np.inf if part.end is None else zero + part.end)
    tick = dt if own <= (1.0 + PERIOD_TOLERANCE) * dt else own
    if last - first < 4.0 * tick:
        spans = "; ".join(f"{name} {s.t[0]:.2f} to {s.t[-1]:.2f} s" for name, s in required.items())
        raise LogError(f"{path}: the quantities have no time in common: {spans}")
    stamps = series["velocity"].t
    parts = _parts_between_pauses(stamps[(stamps >= first) & (stamps <= last)], first, last, tick)
    if (count := int(np.sum(parts[:, 1] - parts[:, 0]))) > LONGEST:
        raise LogError(f"{path}: it has {count} ticks of {tick:.3g} s, more than {LONGEST}; are the times right?")
    alike = all(np.array_equal(series[name].t, stamps) for name in states)
    steps = np.diff(stamps)
    if alike and abs(own - tick) <= PERIOD_TOLERANCE * tick and np.all(np.abs(steps - own) < 0.25 * own):
        return Grid(stamps[(stamps >= first) & (stamps <= last)], own, True)
    return Grid(first + tick * np.concatenate([np.arange(*part) for part in parts.tolist()]), tick, False)


def _parts_between_pauses(stamps: np.ndarray, first: float, last: float, tick: float) -> np.ndarray:
    """Return the first tick of each part and the tick after its last one; the middle of a pause has no ticks."""
    t = np.concatenate([[first], stamps, [last]])
    pauses = np.flatnonzero(np.diff(t) > LONGEST_PAUSE)
    begins = np.ceil((t[pauses + 1] - PAUSE_END - first) / tick)
    ends = np.concatenate([t[pauses] + PAUSE_END, [last]]) - first
    return np.stack([np.concatenate([[0.0], begins]), np.floor(ends / tick + 1e-9) + 1.0], axis=1).astype(int)


def on_one_clock(path: Path, log_map: LogMap, series: dict[str, Series], grid: Grid) -> Ticks:
    """Return the series on a grid, converted by the map.

    Raises:
        LogError: A quantity has the wrong number of columns, or the attitude is not valid.
    """
    W, B = to_world(log_map.frames.world), to_body(log_map.frames.body)
    t, dt = grid.t, grid.dt
    of = {name: _columns(path, log_map, name, series) for name in series if " " not in name}
    there = np.all([mark_known(each, t, dt) for name, each in of.items() if name in STATES], axis=0)
    attitude, rotations = attitudes(of["attitude"].values, log_map.attitude, path)
    stamps = of["attitude"].t
    R = (
        attitude[np.searchsorted(stamps, t)]
        if grid.sampled
        else interpolate_attitudes(stamps[rotations], attitude[rotations], t)
    )
    if not rotations.all():
        there &= hold_last(Series(stamps, rotations[:, None].astype(float)), t)[:, 0] > 0.5
    own_world, own_body = log_map.attitude.world, log_map.attitude.body
    R = (to_world(own_world) if own_world else W) @ R @ (to_body(own_body) if own_body else B).T
    if log_map.attitude.heading:
        c, s = np.cos(np.deg2rad(log_map.attitude.heading)), np.sin(np.deg2rad(log_map.attitude.heading))
        R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ R
    v = _speed(log_map) * interpolate(of["velocity"], t)
    in_world = log_map.velocity is None or log_map.velocity.axes == "world"
    v = v @ W.T if in_world else np.einsum("nij,nj->ni", R, v @ B.T)
    if log_map.position is None:
        steps = np.diff(grid.log_time)[:, None]
        p = np.concatenate([np.zeros((1, 3)), np.cumsum(0.5 * steps * (v[1:] + v[:-1]), axis=0)])
    else:
        p = maps.METRES[log_map.position.unit] * interpolate(of["position"], t) @ W.T
    spin = B * np.linalg.det(B)  # a rate is a pseudovector
    total = Series(of["thrust"].t, collective_of(log_map.thrust, of["thrust"].values)[:, None])
    thrust = _sample_command(total, grid)[:, 0]
    there &= mark_known(of["thrust"], t, dt, hold_s=COMMAND_HELD)
    command = measurement = hover = None
    if log_map.rates is not None and "rates" in of:
        command = maps.RATES[log_map.rates.unit] * _sample_command(of["rates"], grid) @ spin.T
        there &= mark_known(of["rates"], t, dt, hold_s=COMMAND_HELD)
    if log_map.measured_rates is not None and "measured_rates" in of:
        measurement = maps.RATES[log_map.measured_rates.unit] * interpolate(of["measured_rates"], t) @ spin.T
        there &= mark_known(of["measured_rates"], t, dt)
    if "hover" in of:
        hover = share_of(log_map.thrust, hold_last(of["hover"], t)[:, 0])
    if log_map.acceleration is None:
        a = derivative(v, dt)
        there &= around(there, 2)
    else:
        a = maps.ACCELERATIONS[log_map.acceleration.unit] * interpolate(of["acceleration"], t)
        a = a @ W.T if log_map.acceleration.axes == "world" else np.einsum("nij,nj->ni", R, a @ B.T)
        a = a - UP * (log_map.acceleration.gravity == "included")
        there &= mark_known(of["acceleration"], t, dt)
    rates = turning(R, dt) if measurement is None else measurement
    return Ticks(t, p, R, v, a, rates, thrust, command, there, hover, dt, measurement is not None)


def _speed(log_map: LogMap) -> float:
    """Return the factor from the velocity's unit to m/s; a velocity that is not in the log has the position's unit."""
    if log_map.velocity is not None:
        return maps.SPEEDS[log_map.velocity.unit]
    return 1.0 if log_map.position is None else maps.METRES[log_map.position.unit]


def _sample_command(command: Series, grid: Grid) -> np.ndarray:
    """Return a command at each tick: its sample, or its mean over the tick if the command has its own times."""
    samples = grid.sampled and np.mean(np.isin(grid.t, command.t)) > SAMPLED_SHARE
    return hold_last(command, grid.t) if samples else mean_of_steps(command, grid.t, grid.dt)


def turning(R: np.ndarray, dt: float) -> np.ndarray:
    """Return the body rates [rad/s], from central differences of attitudes on a grid."""
    from scipy.spatial.transform import Rotation  # local, because it takes as long to import as all of retrim

    before, after = np.concatenate([R[:1], R[:-1]]), np.concatenate([R[1:], R[-1:]])
    span = np.full(len(R), 2.0 * dt)
    span[[0, -1]] = dt
    angle = Rotation.from_matrix(np.swapaxes(before, 1, 2) @ after).as_rotvec()
    return np.asarray(angle / span[:, None])


def _columns(path: Path, log_map: LogMap, name: str, series: dict[str, Series]) -> Series:
    """Return a series after checking its number of columns."""
    width, result = {"thrust": 1, "hover": 1}.get(name, 3), series[name].values.shape[1]
    if name == "thrust" and result != 1 and (result < MOTORS or log_map.thrust.unit not in ("share", "N")):
        raise LogError(
            f'{path}: thrust needs 1 number or, with unit = "share" or "N", one for each of {MOTORS} motors or more; '
            f"its fields hold {result}"
        )
    if name not in ("attitude", "thrust") and result != width:
        raise LogError(f"{path}: {name} needs {width} number{'s' * (width > 1)}, its fields hold {result}")
    return series[name]
