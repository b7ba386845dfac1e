"""Reads a flight from a log: states and commands on one clock, in retrim's frames and units."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from ...errors import LogError
from .body_log import BodyLog
from .body_map import BodyMap
from .body_reader import body_log_of
from .flight_part import ENDS, flight_part
from .log_map import LogMap
from .marks import marks_of
from .named_maps import AnyMap
from .on_one_clock import PAUSE_END, Ticks, grid_of, on_one_clock
from .other_maps import Other
from .plausibility import check_plausible
from .quantities import read_quantities
from .series import Series
from .thrust_map import normalise_thrust


@dataclass(frozen=True)
class FlightLog:
    """A flight on one clock, with world axes east-north-up and body axes forward-left-up."""

    t: np.ndarray
    """Times from the beginning [s], (n,), one tick apart; long pauses in the samples are shortened."""
    p: np.ndarray
    """Position in the world frame [m], (n, 3)."""
    R: np.ndarray
    """Attitude, body to world, (n, 3, 3)."""
    v: np.ndarray
    """Velocity in the world frame [m/s], (n, 3)."""
    a: np.ndarray
    """Acceleration in the world frame, the derivative of v [m/s^2], (n, 3)."""
    c: np.ndarray
    """Commanded collective thrust, mass-normalised [m/s^2], (n,)."""
    rates: np.ndarray
    """Measured body rates [rad/s], (n, 3)."""
    command: np.ndarray | None
    """Commanded body rates [rad/s], (n, 3); None if the log does not contain them."""
    valid: np.ndarray
    """Ticks at which the vehicle flies and all quantities are known, (n,)."""
    dt: float
    """Tick [s]."""
    full_thrust: float | None
    """Acceleration at full thrust [m/s^2], if the commanded thrust is a share of full thrust."""
    notes: tuple[str, ...]
    """Notes on findings and excluded parts; doubtful findings come first."""
    agreement: Mapping[str, float] = field(default_factory=dict)
    """Agreement of the log's quantities, where 1 is complete agreement; see :data:`retrim.io.logs.agreement.CLAIMS`."""
    warnings: tuple[str, ...] = ()
    """Warnings about agreement that is too low for reliable results."""

    @property
    def seconds(self) -> float:
        """Length of the flight without the excluded parts [s]."""
        return float(np.sum(self.valid) * self.dt)


def read_flight_log(
    path: Path, log_map: AnyMap | None = None, *, dt: float = 0.02, flight: int | None = None
) -> FlightLog:
    """Read a flight with attitudes and velocities.

    If the states arrive about every ``dt``, the log is read sample by sample. A faster log is interpolated. A slower
    log determines the tick.

    Args:
        path: A CSV, NPZ, ULog, MCAP or dataflash file, or a ROS 1 or ROS 2 bag.
        log_map: Map of the log's fields; by default a map for the output of retrim or of a common autopilot.
        dt: Control tick [s].
        flight: Number of the flight in a file with several, from 1.

    Raises:
        LogError: The file cannot be read, a field is missing, or the columns contradict the map.
    """
    log = read_log(path, log_map, dt=dt, flight=flight)
    if isinstance(log, BodyLog):
        raise LogError(f"{path}: the log has no attitudes and velocities; retrim.io.logs.read_log reads it")
    return log


def read_log(
    path: Path, log_map: AnyMap | None = None, *, dt: float = 0.02, flight: int | None = None
) -> FlightLog | BodyLog:
    """Read a flight of any kind: a ``BodyLog`` if the log has no attitudes and velocities.

    Args:
        path: A file as for :func:`read_flight_log`, or a Blackbox log.
        log_map: Map of the log's fields.
        dt: Control tick of a flight with attitudes [s].
        flight: Number of the flight in a file with several, from 1.

    Raises:
        LogError: The file cannot be read, a field is missing, or the columns contradict the map.
    """
    series, used_map, notes = read_quantities(path, log_map, flight)
    if isinstance(used_map, BodyMap):
        return body_log_of(path, used_map, series, notes)
    return _flight_log_of(path, used_map, series, notes, dt)


@np.errstate(all="ignore")  # ticks with numbers that overflow are excluded later
def _flight_log_of(path: Path, used_map: LogMap, series: dict[str, Series], notes: list[str], dt: float) -> FlightLog:
    grid = grid_of(path, series, used_map.part, dt)
    ticks = on_one_clock(path, used_map, series, grid)
    marks = marks_of(used_map, series, grid.t)
    valid, more = flight_part(path, ticks, marks, measured_position=used_map.position is not None)
    notes += more

    def read(other: Other, part: slice) -> Ticks:
        return on_one_clock(path, other.log_map, other.apply(series), replace(grid, t=grid.t[part]))

    scores, warnings = check_plausible(path, used_map, ticks, read, valid)
    c, full, more = normalise_thrust(path, used_map.thrust, ticks, valid)
    notes += more
    log_time = grid.log_time
    pauses = float(grid.t[-1] - grid.t[0] - log_time[-1])
    if gaps := float(np.sum(~ticks.known[ENDS:-ENDS]) * ticks.dt) + pauses:
        notes.append(f"{gaps:.2f} s have gaps in the samples, and are left out")
    if pauses:
        notes.append(
            f"pauses are shortened to {2.0 * PAUSE_END:g} s; the times after them are {pauses:.2f} s earlier in all"
        )
    if len(warnings) and np.ptp(ticks.thrust[valid]) == 0.0:
        notes.insert(0, f"thrust is {ticks.thrust[valid][0]:g} throughout")
    return FlightLog(
        log_time, ticks.p, ticks.R, ticks.v, ticks.a, c, ticks.rates, ticks.command, valid, ticks.dt, full,
        (*warnings, *notes), scores, warnings,
    )  # fmt: skip
