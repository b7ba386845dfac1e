"""Measures how well the quantities in a log agree with each other.

The velocity should be the derivative of the position. The acceleration should lie along the thrust axis and follow the
thrust. The rotation should follow the commanded rates and equal the measured rates. Wind, drag and lags leave a
remainder in every log.
"""

import math
from collections.abc import Callable, Mapping

import numpy as np

from .log_map import LogMap
from .on_one_clock import UP, Ticks, turning
from .resampling import smooth

SMOOTH = 0.2  # time span of differences [s]
LEAST_SPEED, LEAST_TILT = 0.15, 0.03  # [m/s], [rad]: least motion that is compared
LEAST_TURN, LEAST_CLIMB = 0.1, 0.25  # [rad/s], [m/s^2], also
WRONG_SIGN = -0.3  # agreement of one axis below which its sign is wrong, even if the axis contributes little
SLOW_CHANGE = 3.0  # [s]: slower changes, for example from a battery, are removed
LATE = 0.2  # longest delay between a thrust command and the acceleration [s]

CLAIMS: Mapping[str, str] = {
    "motion": "velocity explains {} % of the motion of the position",
    "lift": "attitude explains {} % of the sideways acceleration",
    "thrust": "the size of the thrust agrees with that of the acceleration to {} %",
    "climb": "thrust explains {} % of the changes of the acceleration along its axis",
    "turning": "commanded rates explain {} % of the turning",
    "gyroscope": "measured rates explain {} % of the turning",
}
"""What each figure means."""


def agreement(log_map: LogMap, ticks: Ticks, valid: np.ndarray) -> dict[str, float]:
    """Return the agreement figures, where 1 is complete agreement; a figure is absent if there is too little motion."""
    k = max(1, round(SMOOTH / ticks.dt))
    both = np.convolve(valid, np.ones(k + 1), mode="valid") > k
    if both.sum() < 2 * k:
        return {}

    def mean(x: np.ndarray) -> np.ndarray:
        total = np.cumsum(np.concatenate([np.zeros((1, x.shape[1])), 0.5 * (x[1:] + x[:-1])]), axis=0)
        return np.asarray(((total[k:] - total[:-k]) / k)[both])

    scores = dict[str, float]()
    velocity, velocity_log = ((ticks.p[k:] - ticks.p[:-k]) / (k * ticks.dt))[both], mean(ticks.v)
    independent = log_map.position is not None and log_map.velocity is not None
    if independent and max(_rms(velocity), _rms(velocity_log)) > LEAST_SPEED:
        scores["motion"] = with_signs(
            _explained_share(velocity, velocity_log), velocity, velocity_log, LEAST_SPEED, _explained_share
        )
    specific_force, axis = mean(ticks.a + UP), mean(ticks.R[:, :, 2])
    scores["lift"] = _lift(specific_force, axis)
    along = np.sum(specific_force * axis, axis=1)
    if (scale := log_map.thrust.scale) is not None:
        thrust = scale * float(np.median(mean(ticks.thrust[:, None])))
        had = float(np.median(np.abs(along)))
        scores["thrust"] = 1.0 - abs(math.log2(max(thrust, 1e-6) / max(had, 1e-6)))
    rows = max(1, round(SLOW_CHANGE / ticks.dt))
    changes = along - smooth(along, rows)
    if _beyond_noise(changes, k) > LEAST_CLIMB:
        late = max(1, round(LATE / ticks.dt))
        shifts = [np.concatenate([np.full(lag, ticks.thrust[0]), ticks.thrust])[: len(ticks.t)] for lag in range(late)]
        thrusts = [mean(each[:, None])[:, 0] for each in shifts]
        result = max(correlation(changes, each - smooth(each, rows)) for each in thrusts)
        scores["climb"] = result * abs(result)
    turn_rates = mean(turning(ticks.R, ticks.dt))
    for name, rates in (("turning", ticks.command), ("gyroscope", ticks.rates if ticks.gyroscope else None)):
        if rates is not None and max(_rms(mean(rates)), _rms(turn_rates)) > LEAST_TURN:
            scores[name] = with_signs(alike(turn_rates, mean(rates)), turn_rates, mean(rates), LEAST_TURN, alike)
    return scores


def heading_between(ticks: Ticks, valid: np.ndarray) -> float:
    """Return the rotation about the vertical that aligns the attitudes' tilt with the acceleration [deg]."""
    specific_force, axis = (x - x.mean(axis=0) for x in ((ticks.a + UP)[valid, :2], ticks.R[valid, :2, 2]))
    cross = np.sum(axis[:, 0] * specific_force[:, 1] - axis[:, 1] * specific_force[:, 0])
    return float(np.nan_to_num(np.degrees(np.arctan2(cross, np.sum(axis * specific_force)))))


def _lift(specific_force: np.ndarray, axis: np.ndarray) -> float:
    """Return the worse of two agreements: specific force with thrust axis, and its sideways part with the tilt."""
    alignment = float(
        np.mean(np.sum(specific_force * axis, axis=1) / np.maximum(np.linalg.norm(specific_force, axis=1), 1e-9))
    )
    sideways, tilt = (x[:, :2] - x[:, :2].mean(axis=0) for x in (specific_force, axis))
    if _rms(tilt) <= LEAST_TILT:
        return alignment
    leans = float(np.sum(sideways * tilt) / max(np.linalg.norm(sideways) * np.linalg.norm(tilt), 1e-12))
    return min(alignment, with_signs(leans, sideways, tilt, LEAST_TILT, correlation))


def with_signs(
    score: float, x: np.ndarray, by: np.ndarray, least: float, agree: Callable[[np.ndarray, np.ndarray], float]
) -> float:
    """Return the agreement of all axes, or the agreement of a wrong-signed axis whose motion exceeds ``least``."""
    axes = [(p, q) for p, q in zip(x.T, by.T, strict=True) if min(_size(p), _size(q)) > least]
    return min([score, *(result for p, q in axes if (result := agree(p, q)) < WRONG_SIGN)])


def _beyond_noise(changes: np.ndarray, k: int) -> float:
    """Return the size of mean accelerations without velocity noise, which anticorrelates adjacent spans."""
    if len(changes) < 3 * k:
        return 0.0
    signal = np.mean(changes**2) + 2.0 * np.mean(changes[k:] * changes[:-k])
    return float(np.sqrt(max(0.0, signal / 3.0)))


def _size(x: np.ndarray) -> float:
    return float(np.sqrt(np.mean(x**2)))


def _rms(x: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.sum(x**2, axis=1))))


def _explained_share(x: np.ndarray, by: np.ndarray) -> float:
    """Return the explained share of the larger of the two signals."""
    return 1.0 - float(np.sum((x - by) ** 2) / max(np.sum(x**2), np.sum(by**2), 1e-12))


def alike(x: np.ndarray, by: np.ndarray) -> float:
    """Return the correlation times the square root of the size ratio, so that a lag is not a disagreement."""
    small, large = sorted((float(np.linalg.norm(x)), float(np.linalg.norm(by))))
    return float(np.sum(x * by)) / max(small * large, 1e-12) * float(np.sqrt(small / max(large, 1e-12)))


def correlation(x: np.ndarray, y: np.ndarray) -> float:
    """Return the correlation; zero if the second signal is constant."""
    x, y = x - x.mean(), y - y.mean()
    size = float(np.linalg.norm(x) * np.linalg.norm(y))
    return 0.0 if np.std(y) < 1e-6 * max(1e-12, np.max(np.abs(y))) else float(np.sum(x * y)) / max(size, 1e-12)
