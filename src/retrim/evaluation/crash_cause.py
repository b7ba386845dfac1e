"""Finds the likely cause of a crash, with numbers, from the measurements and commands in the flight's log."""

from collections.abc import Iterator

import numpy as np

from ..physics.state import STANDARD_GRAVITY
from ..runtime.flight import Log

DELAYS, LAGS = range(11), (0.0, 0.02, 0.04, 0.07, 0.1, 0.15, 0.2, 0.3, 0.5)  # [ticks], [s]
TICKS = 12  # shorter flights contain too little data on thrust and rates
DELAY_TOLERANCE = 0.06  # [s], delay of rates beyond that in training; the fit of a fast loop is about this uncertain


def likely_cause(log: Log, response_time: float) -> str | None:
    """Return the first known cause that a log shows, if it shows one.

    Args:
        log: A flight that was terminated.
        response_time: Delay plus lag of the body rates in the training model [s].
    """
    return next(
        (result for cause in (_clock, _numbers, _motion, _rates, _limit) for result in cause(log, response_time)), None
    )


def _clock(log: Log, response_time: float) -> Iterator[str]:
    ticks = np.diff(log.t)
    if len(ticks) and np.all(ticks == 0.0):
        yield "the plant's clock does not advance: Measurement.t must grow with every tick"
    elif len(ticks) and not 0.5 < np.median(ticks) / log.dt < 2.0:
        yield f"measurements are {np.median(ticks):.3g} s apart by the plant's clock, and its tick is {log.dt:g} s"


def _numbers(log: Log, response_time: float) -> Iterator[str]:
    p, R, v = log.measured
    bad = [~np.isfinite(part.reshape(len(part), -1)).all(axis=1) for part in (p, R, v, log.u)]
    if any(map(np.any, bad)):
        parts = zip(("position", "attitude", "velocity", "command"), bad, strict=True)
        names = [name for name, rows in parts if rows.any()]
        first = min(int(np.argmax(rows)) for rows in bad if rows.any())
        yield f"{', '.join(names)}: not a number from {log.t[first]:.2f} s on, as if the thrust or a sensor were not"
        return
    off = np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(3)).max()
    if off > 0.05 or np.linalg.det(R).min() < 0.0:
        det = np.linalg.det(R).min()
        yield f"the attitude is not a rotation: R' R differs from 1 by {off:.2g}, and its determinant is {det:.2g}"


def _motion(log: Log, response_time: float) -> Iterator[str]:
    """Compare velocities with positions, and accelerations with commanded thrust."""
    if len(log.t) < TICKS:
        return
    p, R, v = log.measured
    steps, velocities = np.diff(p, axis=0) / log.dt, 0.5 * (v[1:] + v[:-1])
    share = np.sum(steps * velocities) / max(np.sum(steps**2), 1e-9)
    if np.sqrt(np.mean(steps**2)) > 0.1 and not 0.7 < share < 1.4:
        yield f"the velocity is {share:.2f} times the derivative of the position"
    a = np.diff(v, axis=0) / log.dt
    up, c = R[1:, :, 2], log.u[1:, 0]
    expected = c * up[:, 2] - np.mean(c * up[:, 2])
    slope = np.sum(a[:, 2] * expected) / max(np.sum(expected**2), 1e-9)
    if np.std(expected) > 0.5 and slope < -0.3:
        yield (
            f"the vertical acceleration is {slope:.2f} times what is commanded: the axes may point down (NED), and the "
            f"world must have z upwards, the body forward, left and up"
        )
        return
    lift = np.sum((a + np.array([0.0, 0.0, STANDARD_GRAVITY])) * up, axis=1)
    gain = np.median(lift) / max(np.median(c), 1e-9)
    if not 0.7 < gain < 1.4:
        yield f"the thrust is {gain:.2f} times what is commanded: look at mass, thrust_max and the thrust map"


def _rates(log: Log, response_time: float) -> Iterator[str]:
    """Compare roll and pitch rates with their commands, behind delays and lags."""
    if len(log.t) < TICKS:
        return
    rates, rate_commands = body_rates(log.measured.R, log.dt)[:, :2], log.u[1:, 1:3]
    size, command_size = (float(np.sqrt(np.mean(part**2))) for part in (rates, rate_commands))
    if command_size < 0.05:
        return
    fits = {(delay, lag): _fit(rates, rate_commands, delay, lag, log.dt) for delay in DELAYS for lag in LAGS}
    (delay, lag), (gain, match) = max(fits.items(), key=lambda fit: abs(fit[1][1]))
    late = delay * log.dt + lag
    numbers = f"{size:.1f} rad/s (rms) where {command_size:.1f} rad/s were commanded, {late:.2f} s later"
    if match < -0.5:
        yield f"the vehicle turns against its command ({numbers}): look at the signs of roll and pitch"
    elif abs(match) < 0.3:
        yield f"the body rates do not follow their commands ({numbers}, correlation {match:.2f})"
    elif late > response_time + DELAY_TOLERANCE:
        yield (
            f"the vehicle turned with {numbers}, and the policy was trained for {response_time:.2f} s: give its "
            f"rate_lag and command_delay in the vehicle file, or fly a policy of hover/any, which identifies them"
        )
    elif gain > 1.4:
        yield f"the vehicle turned with {numbers}: its rate loop oscillates, or the rates are in another unit"


def _limit(log: Log, response_time: float) -> Iterator[str]:
    largest = log.u[:, 0].max()
    share = float(np.mean(log.u[1:, 0] > 0.99 * largest)) if len(log.t) > TICKS else 0.0
    if share > 0.5 and largest > 1.2 * STANDARD_GRAVITY:
        yield f"the thrust was at its largest, {largest:.1f} m/s^2, in {share:.0%} of the flight"


def body_rates(R: np.ndarray, dt: float) -> np.ndarray:
    """Return the mean body rates over each tick [rad/s] from attitudes with a leading time axis."""
    turn = np.swapaxes(R[:-1], 1, 2) @ R[1:]
    skew = 0.5 * (turn - np.swapaxes(turn, 1, 2))
    axis = np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], axis=1)
    sine, cosine = np.linalg.norm(axis, axis=1), 0.5 * (np.trace(turn, axis1=1, axis2=2) - 1.0)
    angle = np.arctan2(sine, cosine)
    return np.asarray(axis * (np.where(sine > 1e-9, angle / np.maximum(sine, 1e-9), 1.0) / dt)[:, None])


def _fit(rates: np.ndarray, rate_commands: np.ndarray, delay: int, lag: float, dt: float) -> tuple[float, float]:
    """Return the gain and the correlation between measured rates and delayed, lagged commands."""
    late = np.concatenate([np.zeros((delay, 2)), rate_commands[: len(rate_commands) - delay]])
    share, acting, result = np.exp(-dt / lag) if lag else 0.0, np.zeros(2), np.empty_like(late)
    for k, each in enumerate(late):
        acting = each + share * (acting - each)
        result[k] = acting
    power, both = np.sum(result**2), np.sum(result * rates)
    return float(both / max(power, 1e-9)), float(both / max(np.sqrt(power * np.sum(rates**2)), 1e-9))
