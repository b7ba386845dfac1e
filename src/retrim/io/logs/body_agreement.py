"""Checks a log of commands, gyroscope and accelerometer, and names a wrong sign or unit in its map."""

import dataclasses
from pathlib import Path

import numpy as np

from ...errors import LogError
from ...physics.state import STANDARD_GRAVITY
from . import log_map as maps
from .agreement import CLAIMS, alike, correlation
from .body_log import BodyLog
from .body_map import BodyMap
from .plausibility import DOUBT_LIMITS, EXPLANATIONS, LEAST_AGREEMENT, REFUSAL_LIMITS
from .resampling import smooth

AVERAGING_TIME, LONGEST_DELAY = 0.1, 0.2  # [s]
SLOW_CHANGE = 3.0  # [s]: slower changes of the thrust are removed
LEAST_TURN, LEAST_CLIMB = 0.1, 0.25  # [rad/s], [m/s^2]: least motion that is compared
UPWARD = (0.4, 2.5)  # limits for the mean specific force along the thrust axis [g]


def check_body_log(path: Path, body_map: BodyMap, log: BodyLog) -> tuple[dict[str, float], tuple[str, ...]]:
    """Return the agreement figures of a log, where 1 is complete agreement, and a warning for each low figure.

    Raises:
        LogError: The vehicle turns against its commands, or the accelerometer does not measure the thrust.
    """
    scores = dict[str, float]()
    if not np.any(log.rates[log.valid]):
        raise LogError(f"{path}: the gyroscope measures 0 throughout; measured_rates.fields must name one that is used")
    if log.command is not None and (best := _turning(log)) is not None:
        scores["turning"], delay, axes = best
        if min(axes.values(), default=1.0) < REFUSAL_LIMITS["turning"]:
            raise LogError(f"{path}: {_correct_signs(body_map, axes)}")
        unit = _other_unit(body_map, log, delay)
        if scores["turning"] < DOUBT_LIMITS["turning"] and unit:
            raise LogError(
                f"{path}: {EXPLANATIONS['turning']} ({100 * scores['turning']:.0f} % agreement); with {unit}"
            )
    if log.specific_force is not None:
        upward = float(np.median(log.specific_force[log.valid, 2])) / STANDARD_GRAVITY
        if not UPWARD[0] <= upward <= UPWARD[1]:
            remedy = "the sign of acceleration.fields or frames.body is wrong" if upward < 0.0 else "the unit is wrong"
            raise LogError(
                f"{path}: the accelerometer measures {upward:.3g} g upwards in flight instead of 1; {remedy}"
            )
        if (climb := _climb(log)) is not None:
            scores["climb"] = climb
    return scores, tuple(
        f"{CLAIMS[name].format(max(0, round(100 * score)))}, {100 * DOUBT_LIMITS[name]:.0f} % are expected"
        for name, score in scores.items()
        if score < DOUBT_LIMITS[name]
    )


def _turning(log: BodyLog) -> tuple[float, int, dict[int, float]] | None:
    """Return the agreement for the best delay, this delay [ticks], and the agreement of each axis that moves."""
    assert log.command is not None
    rows = max(1, round(AVERAGING_TIME / log.dt))
    rates, command = (np.stack([smooth(x, rows) for x in each.T], axis=1) for each in (log.rates, log.command))
    best: tuple[float, int, dict[int, float]] | None = None
    for delay in range(0, max(2, round(LONGEST_DELAY / log.dt)), max(1, round(0.01 / log.dt))):
        both = log.valid[delay:] & log.valid[: len(log.valid) - delay]
        y, u = rates[delay:][both], command[: len(command) - delay][both]
        if len(y) < 2 or max(np.sqrt(np.mean(y**2)), np.sqrt(np.mean(u**2))) < LEAST_TURN:
            continue
        moving = [k for k in range(3) if min(np.std(y[:, k]), np.std(u[:, k])) > LEAST_TURN]
        score, axes = alike(y, u), {k: alike(y[:, [k]], u[:, [k]]) for k in moving}
        if best is None or score > best[0]:
            best = score, delay, axes
    return best


def _correct_signs(body_map: BodyMap, axes: dict[int, float]) -> str:
    """Return the error for axes that turn against their commands, and the map's statement that corrects it."""
    spec = body_map.rates
    names = " and ".join("xyz"[k] for k, score in axes.items() if score < REFUSAL_LIMITS["turning"])
    message = f"{EXPLANATIONS['turning']} about {names} ({100 * min(axes.values()):.0f} % agreement)"
    if spec is None or len(spec.fields) != 3:
        return message
    fields = [
        (name.removeprefix("-") if name.startswith("-") else f"-{name}") if axes.get(k, 1.0) < REFUSAL_LIMITS["turning"]
        else name for k, name in enumerate(spec.fields)
    ]  # fmt: skip
    return f"{message}; with rates.fields = [" + ", ".join(f'"{name}"' for name in fields) + "] it would"


def _other_unit(body_map: BodyMap, log: BodyLog, delay: int) -> str:
    """Return the unit with which commanded and measured rates agree, or an empty string."""
    if body_map.rates is None or log.command is None:
        return ""
    own = maps.RATES[body_map.rates.unit]
    for unit, factor in maps.RATES.items():
        other = dataclasses.replace(log, command=log.command * (factor / own))
        result = _turning(other) if unit != body_map.rates.unit else None
        if result is not None and result[0] > LEAST_AGREEMENT:
            return f'rates.unit = "{unit}" it would'
    return ""


def _climb(log: BodyLog) -> float | None:
    """Return how well the thrust explains the changes of the specific force along its axis; None if it is steady."""
    assert log.specific_force is not None
    near, slow = (max(1, round(span / log.dt)) for span in (AVERAGING_TIME, SLOW_CHANGE))

    def changes(x: np.ndarray) -> np.ndarray:
        return np.asarray(smooth(x, near) - smooth(x, slow))

    force, thrust = changes(log.specific_force[:, 2]), changes(log.motors.mean(axis=1))
    if np.std(force[log.valid]) < LEAST_CLIMB:
        return None
    best = -1.0
    for delay in range(0, max(2, round(LONGEST_DELAY / log.dt)), max(1, round(0.01 / log.dt))):
        both = log.valid[delay:] & log.valid[: len(log.valid) - delay]
        if both.sum() > 2:
            best = max(best, correlation(force[delay:][both], thrust[: len(thrust) - delay][both]))
    return best * abs(best)
