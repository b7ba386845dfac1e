"""Reads a flight from a log without attitudes and velocities: commands, gyroscope and accelerometer on one clock."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from ...errors import LogError
from . import log_map as maps
from .axes import to_body
from .body_agreement import check_body_log
from .body_log import BodyLog
from .body_map import BodyMap
from .collective import share_of
from .ground import mark_idle
from .marks import landed_at
from .on_one_clock import COMMAND_HELD, MOTORS
from .resampling import mark_known, mean_between, mean_of_steps, period
from .series import Series

SHORTEST_TICK, LONGEST_TICK = 0.002, 0.052  # [s]: shortest tick, and slowest rates from which a lag can be identified
LONGEST_S = 180.0  # [s]: longer flights are not needed to identify a vehicle
SHORT_GAP = 0.02  # [s]: a shorter gap between samples is bridged
LEAST_S = 1.0  # [s]: shortest flight
FILTER = "acceleration filter"  # series of one sample: the lag of the accelerometer's filter [s]


@np.errstate(all="ignore")  # ticks with numbers that overflow are excluded later
def body_log_of(path: Path, body_map: BodyMap, series: Mapping[str, Series], notes: list[str]) -> BodyLog:
    """Return a flight from the series of a log.

    Args:
        path: The log file, for messages.
        body_map: The map with which the series were read.
        series: The series, by quantity.
        notes: Notes from reading.

    Raises:
        LogError: The samples are too rare or too few, or the quantities contradict each other.
    """
    _check_widths(path, series)
    t, dt, cut = _grid(path, body_map, series)
    turn = to_body(body_map.frames.body)
    spin = turn * np.linalg.det(turn)  # a rate is a pseudovector
    thrust = body_map.thrust
    shares = share_of(replace(thrust, curve=0.0), thrust.sign * series["thrust"].values)
    motors = mean_of_steps(Series(series["thrust"].t, shares), t, dt)
    valid = mark_known(series["thrust"], t, dt, hold_s=COMMAND_HELD)
    rates = _rates(body_map.measured_rates, mean_between(series["measured_rates"], t, dt), spin)
    valid &= mark_known(series["measured_rates"], t, dt, hold_s=SHORT_GAP)
    command = force = None
    if body_map.rates is not None and "rates" in series:
        command = _rates(body_map.rates, mean_of_steps(series["rates"], t, dt), spin)
        valid &= mark_known(series["rates"], t, dt, hold_s=COMMAND_HELD)
    if body_map.acceleration is not None and "acceleration" in series:
        unit = maps.ACCELERATIONS[body_map.acceleration.unit]
        force = unit * mean_between(series["acceleration"], t, dt) @ turn.T
        valid &= mark_known(series["acceleration"], t, dt, hold_s=SHORT_GAP)
    columns = [motors, rates, *(each for each in (command, force) if each is not None)]
    valid &= np.all(np.isfinite(np.concatenate(columns, axis=1)), axis=1)
    grounded = _on_ground(path, motors, valid, dt) | landed_at(body_map.landed, series, t)
    if (seconds := float(np.sum(valid & grounded) * dt)) > 0.5:
        notes.append(f"{seconds:.1f} s with the motors at rest or on the ground are left out")
    valid &= ~grounded
    if np.sum(valid) * dt < LEAST_S:
        why = f" ({'; '.join(notes)})" if notes else ""
        raise LogError(f"{path}: {np.sum(valid) * dt:.2f} s of flight are left, at least {LEAST_S:g} s are needed{why}")
    if cut:
        notes.append(f"the first {LONGEST_S:g} s of the flight are used; [part] in a map chooses others")
    if command is None:
        notes.append("the log has no commanded rates")
    if force is None:
        notes.append("the log has no accelerometer")
    lag = float(series[FILTER].values[0, 0]) if FILTER in series else 0.0
    log = BodyLog(t - t[0], motors, rates, command, force, valid, dt, thrust.curve or None, lag, tuple(notes))
    scores, warnings = check_body_log(path, body_map, log)
    return replace(log, agreement=scores, warnings=warnings, notes=(*warnings, *notes))


def _grid(path: Path, body_map: BodyMap, series: Mapping[str, Series]) -> tuple[np.ndarray, float, bool]:
    """Return the clock, its tick, and whether the flight was cut."""
    needed = {name: each for name, each in series.items() if " " not in name}
    own = max(period(series[name]) for name in ("measured_rates", "rates") if name in series)
    if own > LONGEST_TICK:
        raise LogError(
            f"{path}: rates come every {own:.3g} s; lags need a sample every {LONGEST_TICK:.2g} s at least; "
            f"log them faster (Betaflight: blackbox_sample_rate; ArduPilot: LOG_BITMASK with fast attitude)"
        )
    zero = min(each.t[0] for each in needed.values())
    first = max(max(each.t[0] for each in needed.values()), zero + body_map.part.start)
    last = min(each.t[-1] for each in needed.values())
    if body_map.part.end is not None:
        last = min(last, zero + body_map.part.end)
    cut, dt = bool(last - first > LONGEST_S), max(own, SHORTEST_TICK)
    n = int(min(last - first, LONGEST_S) / dt + 1e-9)
    if n < 4:
        spans = "; ".join(f"{name} {s.t[0]:.2f} to {s.t[-1]:.2f} s" for name, s in needed.items())
        raise LogError(f"{path}: the quantities have no time in common: {spans}")
    return first + dt * np.arange(n), dt, cut


def _rates(spec: maps.BodyRates, values: np.ndarray, spin: np.ndarray) -> np.ndarray:
    return np.asarray(maps.RATES[spec.unit] * values @ spin.T)


def _on_ground(path: Path, motors: np.ndarray, valid: np.ndarray, dt: float) -> np.ndarray:
    """Return where the motors only idle."""
    if not valid.any():
        return np.zeros(len(motors), dtype=bool)
    thrust = motors.mean(axis=1)
    if not np.any(thrust[valid] > 0.0):
        raise LogError(f"{path}: thrust is never above zero; thrust.fields must name the command that is in use")
    return mark_idle(thrust, valid, max(1, round(0.5 / dt)))


def _check_widths(path: Path, series: Mapping[str, Series]) -> None:
    for name, each in series.items():
        count = each.values.shape[1]
        if name == "thrust" and count != 1 and count < MOTORS:
            raise LogError(
                f"{path}: thrust needs 1 number, or one for each of {MOTORS} motors or more; its fields hold {count}"
            )
        if name in ("rates", "measured_rates", "acceleration") and count != 3:
            raise LogError(f"{path}: {name} needs 3 numbers, its fields hold {count}")
