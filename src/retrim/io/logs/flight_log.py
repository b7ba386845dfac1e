"""A flight from a log: states and commands on one clock, in the frames and units of this package."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import LogError
from ...physics.state import STANDARD_GRAVITY
from . import log_map as maps
from .csv_file import read_csv
from .log_map import LogMap, read_map
from .npz_file import read_npz
from .on_one_clock import STATES, UP, Ticks, grid_of, on_one_clock
from .plausibility import check_plausible
from .resampling import around, smoothed
from .ros_bag import read_bag
from .series import Clock, LogReader, Series
from .times import in_order
from .ulog_file import read_ulog

READERS: dict[str, LogReader] = {
    ".csv": read_csv, ".tsv": read_csv, ".txt": read_csv, ".npz": read_npz, ".ulg": read_ulog, ".ulog": read_ulog,
    ".bag": read_bag, ".mcap": read_bag, ".db3": read_bag,
}  # fmt: skip
"""By the end of the name; a folder is a bag of ROS 2."""
MAPS = {
    ".npz": "retrim-npz", ".csv": "retrim-csv", ".mcap": "retrim-mcap", ".ulg": "px4", ".ulog": "px4", ".bag": "mavros"
}  # fmt: skip
"""What a log is taken for without a map."""
FLIES = 0.3  # share of the largest thrusts above which a vehicle is in the air
LEAST = 1.0  # [s] of flight
JUMP = 15.0  # [m/s] beyond the speed of the vehicle: a position that moves faster has jumped
ENDS = 2  # ticks at each end that have no derivative
FROZEN = 0.3  # [s] for which the position of a vehicle in the air has not changed


@dataclass(frozen=True)
class FlightLog:
    """A flight on one clock; world ENU, body forward-left-up."""

    t: np.ndarray
    """Times since the beginning [s], (n,), one tick apart."""
    p: np.ndarray
    """World [m], (n, 3)."""
    R: np.ndarray
    """Body to world, (n, 3, 3)."""
    v: np.ndarray
    """World [m/s], (n, 3)."""
    a: np.ndarray
    """Acceleration, the derivative of v, world [m/s^2], (n, 3)."""
    c: np.ndarray
    """Commanded collective thrust, mass-normalised [m/s^2], (n,)."""
    rates: np.ndarray
    """Measured body rates [rad/s], (n, 3)."""
    command: np.ndarray | None
    """Commanded body rates [rad/s], (n, 3); None if the log has none."""
    valid: np.ndarray
    """Where the vehicle flies and all of these are known, (n,)."""
    dt: float
    """Tick [s]."""
    full_thrust: float | None
    """For a thrust that is a share: what all of it gives [m/s^2]."""
    notes: tuple[str, ...]
    """What was left out or found."""

    @property
    def seconds(self) -> float:
        """Length of the flight without what was left out [s]."""
        return float(np.sum(self.valid) * self.dt)


def read_flight_log(path: Path, log_map: LogMap | None = None, *, dt: float = 0.02) -> FlightLog:
    """Read a flight.

    A log whose states come about every ``dt`` is taken sample by sample; one that is faster is interpolated; of one
    that is slower the tick is the log's.

    Args:
        path: CSV, NPZ, ULog, bag of ROS 1 or 2, or MCAP.
        log_map: What is where in it; by default what this package or the usual autopilot of the format writes.
        dt: Control tick [s].

    Raises:
        LogError: The file cannot be read, a field is not there, or the columns cannot be what the map says.
    """
    reader = _reader(path)
    chosen = log_map or read_map(_usual(path))
    wanted = {name: tuple(each.fields) for name, each in _quantities(chosen).items()}
    if isinstance(chosen.thrust.hover, str):
        wanted["hover"] = (chosen.thrust.hover,)
    if chosen.time is not None and chosen.time.age is not None:
        wanted["age"] = (chosen.time.age,)
    clock = None if chosen.time is None else Clock(chosen.time.field, maps.SECONDS[chosen.time.unit])
    try:
        raw, notes = reader(path, wanted, clock)
    except LogError as error:
        if log_map is not None or "no field" not in str(error):
            raise
        raise LogError(f"{error}; without a map it is read as {_usual(path)!r}: give --map map.toml") from error
    series = dict[str, Series]()
    age = raw.pop("age", None)
    if age is not None and clock is not None:  # as old as the log says, they were true earlier
        for name in STATES:
            raw[name] = Series(raw[name].t - clock.scale * age.values[:, 0], raw[name].values)
    for name, each in raw.items():
        series[name], more = in_order(each, name, path)
        notes += more
    grid = grid_of(path, series, chosen.part, dt)
    ticks = on_one_clock(path, chosen, series, grid)
    valid, more = _flown(path, ticks)
    notes += more
    check_plausible(path, chosen, lambda other: on_one_clock(path, other, series, grid), valid)
    c, full = _thrust(path, chosen, ticks, valid)
    if full is not None and chosen.thrust.hover is None:
        notes.append(f"thrust map found from the flight: hover at {STANDARD_GRAVITY / full:.3f}")
    if gaps := int(np.sum(~ticks.known[ENDS:-ENDS])):
        notes.append(f"{gaps * ticks.dt:.2f} s have gaps in the samples, and are left out")
    return FlightLog(
        ticks.t - grid.t[0], ticks.p, ticks.R, ticks.v, ticks.a, c, ticks.rates, ticks.command, valid, ticks.dt, full,
        tuple(notes),
    )  # fmt: skip


def _reader(path: Path) -> LogReader:
    if not path.exists():
        raise LogError(f"{path}: no such file")
    if path.is_dir():
        return read_bag
    if path.suffix.lower() not in READERS:
        raise LogError(f"{path}: no log that is known; there are {', '.join(READERS)}, and folders of ROS 2")
    if path.stat().st_size == 0:
        raise LogError(f"{path}: it is empty")
    return READERS[path.suffix.lower()]


def _usual(path: Path) -> str:
    name = MAPS.get(path.suffix.lower())
    if name is None:
        raise LogError(f"{path}: say what is where in it, as --map map.toml; maps by name: {', '.join(maps.KNOWN)}")
    return name


def _quantities(chosen: LogMap) -> dict[str, Any]:
    names = ("position", "velocity", "attitude", "thrust", "rates", "measured_rates", "acceleration")
    return {name: spec for name in names if (spec := getattr(chosen, name)) is not None}


def _flown(path: Path, ticks: Ticks) -> tuple[np.ndarray, list[str]]:
    """Return where the vehicle flies and everything is known, with notes on what is left out.

    Raises:
        LogError: Hardly anything is left.
    """
    notes, dt = list[str](), ticks.dt
    if ticks.thrust[ticks.known].max(initial=0.0) <= 0.0:
        raise LogError(f'{path}: thrust is never above zero; if it points downwards the map must say positive = "down"')
    smooth = smoothed(ticks.thrust, max(1, round(1.0 / dt)))
    airborne = smooth > FLIES * np.percentile(smooth[ticks.known], 95)
    if (ground := float(np.sum(~airborne) * dt)) > 0.5:
        notes.append(f"{ground:.1f} s without thrust, on the ground, are left out")
    moved = np.diff(ticks.p, axis=0) - 0.5 * dt * (ticks.v[1:] + ticks.v[:-1])
    jumps = np.concatenate([[False], np.linalg.norm(moved, axis=1) > JUMP * dt + 0.05])
    still = np.concatenate([[False], np.all(np.diff(ticks.p, axis=0) == 0.0, axis=1)])
    length = max(2, round(FROZEN / dt))
    frozen = _runs(still, length) & airborne
    if np.mean(frozen[airborne]) > 0.5:
        raise LogError(f"{path}: position does not change for {np.sum(frozen) * dt:.1f} s of the flight")
    if frozen.any():
        notes.append(f"position does not change for {np.sum(frozen) * dt:.2f} s in the air, which are left out")
    if np.mean(jumps) > 0.2:
        raise LogError(
            f"{path}: position moves {np.median(np.linalg.norm(moved, axis=1)) / dt:.3g} m/s faster than velocity says "
            f"in {100 * np.mean(jumps):.0f} % of the flight; are the units right?"
        )
    if jumps.any():
        notes.append(f"position jumps {np.sum(jumps)} times, by up to {np.linalg.norm(moved, axis=1).max():.2f} m; "
                     f"what is around it is left out")  # fmt: skip
    valid = ticks.known & airborne & ~frozen & around(~jumps, 2)
    if np.sum(valid) * dt < LEAST:
        why = f" ({'; '.join(notes)})" if notes else ""
        raise LogError(f"{path}: {np.sum(valid) * dt:.2f} s of flight are left, at least {LEAST:g} s are needed{why}")
    return valid, notes


def _runs(flags: np.ndarray, length: int) -> np.ndarray:
    """Return where flags are part of a run of at least that length."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(int), [0]])))
    found = np.zeros(len(flags), dtype=bool)
    for first, last in zip(edges[::2], edges[1::2], strict=True):
        found[first:last] = last - first >= length
    return found


def _thrust(path: Path, chosen: LogMap, ticks: Ticks, valid: np.ndarray) -> tuple[np.ndarray, float | None]:
    """Return the thrust, mass-normalised [m/s^2], and what all of it gives if it was a share."""
    spec = chosen.thrust
    if spec.scale is not None:
        return spec.scale * ticks.thrust, None
    if spec.hover is None:
        felt = ticks.a[valid] + UP
        along, share = np.sum(felt * ticks.R[valid, :, 2], axis=1), ticks.thrust[valid]
        full = float(np.sum(share * along) / np.sum(share**2))
        return full * ticks.thrust, full
    hover = ticks.hover if ticks.hover is not None else np.full(len(ticks.t), float(spec.hover))
    if not np.all(hover[valid] > 0.01):
        raise LogError(f"{path}: thrust at hover, {spec.hover!r}, is not positive all the time")
    return STANDARD_GRAVITY * ticks.thrust / hover, float(STANDARD_GRAVITY / np.median(hover[valid]))
