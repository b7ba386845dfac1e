"""Identifies a vehicle from its commands, gyroscope and accelerometer, without attitudes and velocities.

Measured body rates are compared with commanded ones, and the specific force along the thrust axis with the motor
commands. Both follow after a delay, behind a lag; see :mod:`retrim.replay.response_fit`. The delay counts from the
setpoint in the autopilot, so that it does not include the delay of a link.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ..errors import LogError
from ..estimation.command_path.response import damping_of
from ..io.logs import BodyLog
from ..physics.state import STANDARD_GRAVITY
from .identification import PERCENTILES, Estimate, IdentifiedVehicle
from .response_fit import Fit, Path, Products, fit_response, respond

BLOCK, DRAWS = 1.0, 60  # length of a block [s], and number of bootstrap samples
LEAST_BLOCKS = 8  # smallest number of blocks
WARM_UP = 0.3  # [s], at the beginning of a piece of flight, where the response depends on commands before the piece
POOL = 0.05  # [s]: time over which measurements are averaged to find whether commands explain them
LEAST_EXPLANATION = 0.6  # least share of the changes that commands must explain
TWO_EQUAL_POLES = 1.0 / 3.0  # shape of critical damping
LEAST_RINGING = 0.05  # smallest shape of a response that is not of first order
WIDEST_INTERVAL = 0.5  # a value whose interval is wider than this share of it is not determined


@dataclass(frozen=True)
class BodyIdentification:
    """Values of a vehicle that follow from commands, gyroscope and accelerometer."""

    vehicle: IdentifiedVehicle
    hover: Estimate | None
    """Motor command at hover, as a share of the full command."""
    curve: Estimate | None
    """Thrust (1 - curve) s + curve s^2 of a motor command s; None if the log does not determine it."""
    largest: float
    """Largest motor command in the flight, mean over the motors; the full thrust is an extrapolation from it."""
    explained: dict[str, float]
    """Share of the changes that commands explain: rates, yaw, thrust."""

    @property
    def known(self) -> bool:
        """Whether the log determines at least one value."""
        return self.vehicle.known or self.hover is not None


class _Channel(NamedTuple):
    """Sums of a channel, and the share of its changes that commands explain."""

    products: Products
    best: Fit
    explained: float


def identify_body(log: BodyLog, *, seed: int = 0) -> BodyIdentification:
    """Identify a vehicle from a flight.

    Args:
        log: The flight. More rotation and more changes of the thrust determine more parameters.
        seed: Seed for the bootstrap.

    Raises:
        LogError: The flight is too short.
    """
    blocks = _blocks(log)
    if len(blocks) < LEAST_BLOCKS:
        raise LogError(
            f"{len(blocks) * BLOCK:g} s of flight in one piece are left; identification needs at least "
            f"{LEAST_BLOCKS * BLOCK:g} s"
        )
    ones, channels = np.ones(len(blocks)), dict[str, _Channel]()
    if log.command is not None:
        level = _rates(log, log.command, blocks, [0, 1], None)
        if level.best.path.ringing < LEAST_RINGING:
            best = fit_response(level.products.weigh(ones), log.dt, start=level.best, shaped=False)
            level = level._replace(best=best)
        channels["rates"] = level
        channels["yaw"] = _rates(log, log.command, blocks, [2], level.best.path)
    if log.specific_force is not None:
        channels["thrust"] = _thrust(log, log.specific_force, blocks)
    explained = {name: each.explained for name, each in channels.items()}
    channels = {
        name: each for name, each in channels.items() if each.explained > LEAST_EXPLANATION and each.best.gain > 0.0
    }
    rng = np.random.default_rng(seed)
    draws = [rng.integers(0, len(blocks), len(blocks)) for _ in range(DRAWS)]
    fits = {name: [each.best] for name, each in channels.items()}
    for draw in draws:
        count = np.bincount(draw, minlength=len(blocks)).astype(float)
        level_path: Path | None = None
        for name in (name for name in ("rates", "yaw", "thrust") if name in channels):
            each = channels[name]
            shaped = name == "rates" and each.best.path.ringing > 0.0
            fixed = level_path if name == "yaw" else None
            fit = fit_response(each.products.weigh(count), log.dt, start=each.best, fixed=fixed, shaped=shaped)
            level_path = fit.path if name == "rates" else level_path
            fits[name].append(fit)
    return _result(log, fits, explained)


def _result(log: BodyLog, fits: dict[str, list[Fit]], explained: dict[str, float]) -> BodyIdentification:
    def of(values: list[float]) -> Estimate:
        return Estimate(values[0], *(float(q) for q in np.percentile(values[1:], PERCENTILES)))

    def gain_and_lag(name: str) -> tuple[Estimate | None, Estimate | None]:
        if name not in fits:
            return None, None
        return of([fit.gain for fit in fits[name]]), of([fit.path.lag for fit in fits[name]])

    level, thrust = fits.get("rates"), fits.get("thrust")
    (rate_gain, rate_lag), (yaw_gain, yaw_lag) = gain_and_lag("rates"), gain_and_lag("yaw")
    damping = None
    if level is not None and level[0].path.ringing > 0.0:
        low, middle, high = (float(damping_of(x)) for x in _ends([fit.path.ringing for fit in level]))
        damping = Estimate(middle, low, high)
    hover = full = thrust_lag = curve = None
    if thrust is not None:
        curves = [log.curve if log.curve is not None else fit.curve for fit in thrust]
        hover = _certain(of([_hover(fit.gain, e) for fit, e in zip(thrust, curves, strict=True)]))
        full, thrust_lag = _certain(of([fit.gain for fit in thrust])), of([fit.path.lag for fit in thrust])
        curve = of(curves) if log.curve is None else None
    vehicle = IdentifiedVehicle(
        delay=None if level is None else of([fit.path.delay for fit in level]), thrust_gain=None, thrust_offset=None,
        full_thrust=full, thrust_lag=thrust_lag, rate_lag=rate_lag, rate_gain=rate_gain, yaw_lag=yaw_lag,
        yaw_gain=yaw_gain, drag=(None, None, None), unexplained=float("nan"), rate_damping=damping,
    )  # fmt: skip
    largest = float(np.max(log.motors[log.valid].mean(axis=1)))
    return BodyIdentification(vehicle, hover, curve, largest, explained)


def _ends(ringing: list[float]) -> tuple[float, float, float]:
    """Return the shapes of the smallest, the best and the largest damping."""
    low, high = np.percentile(ringing[1:], PERCENTILES)
    return max(float(high), 1e-3), max(ringing[0], 1e-3), max(float(low), 1e-3)


def _certain(each: Estimate) -> Estimate | None:
    """Return an estimate, or None if its interval is wide."""
    return each if each.value > 0.0 and each.high - each.low < WIDEST_INTERVAL * each.value else None


def _hover(full: float, curve: float) -> float:
    """Return the command at which the thrust is the weight; ``full`` is the acceleration at full command."""
    share = STANDARD_GRAVITY / max(full, 1e-9)
    if curve < 1e-6:
        return share
    return float((np.sqrt((1.0 - curve) ** 2 + 4.0 * curve * share) - (1.0 - curve)) / (2.0 * curve))


def _rates(log: BodyLog, command: np.ndarray, blocks: np.ndarray, axes: list[int], fixed: Path | None) -> _Channel:
    products = Products.of([command[:, axes]], log.rates[:, axes], blocks, log.dt, bias=True)
    best = fit_response(products.weigh(np.ones(len(blocks))), log.dt, fixed=fixed)
    predicted = best.gain * respond(command[:, axes], log.dt, best.path)
    return _Channel(products, best, _explanation(log.rates[:, axes], predicted, blocks, log.dt))


def _thrust(log: BodyLog, force: np.ndarray, blocks: np.ndarray) -> _Channel:
    """Return the thrust channel: the specific force is k ((1 - e) s + e s^2), the mean over the motors."""
    linear, square = log.motors.mean(axis=1), (log.motors * np.abs(log.motors)).mean(axis=1)
    if log.filter_lag > 0.0:  # the motor commands pass through the accelerometer's filter, too
        measured = Path(0.0, log.filter_lag, TWO_EQUAL_POLES)
        linear, square = (respond(each, log.dt, measured) for each in (linear, square))
    if log.curve is None:
        inputs = [linear[:, None], square[:, None]]
    else:
        inputs = [((1.0 - log.curve) * linear + log.curve * square)[:, None]]
    products = Products.of(inputs, force[:, 2:], blocks, log.dt, bias=False)
    best = fit_response(products.weigh(np.ones(len(blocks))), log.dt, shaped=False)
    e = best.curve if log.curve is None else log.curve
    predicted = best.gain * respond((1.0 - e) * linear + e * square, log.dt, best.path)
    return _Channel(products, best, _explanation(force[:, 2:], predicted[:, None], blocks, log.dt))


def _explanation(y: np.ndarray, predicted: np.ndarray, blocks: np.ndarray, dt: float) -> float:
    """Return the share of the changes of means over a short time that a prediction explains."""
    pool = max(1, round(POOL / dt))
    rows = blocks[:, : blocks.shape[1] - blocks.shape[1] % pool]
    shape = (-1, pool, y.shape[1])
    mean, model = (x[rows].reshape(shape).mean(axis=1) for x in (y, predicted))
    error = (mean - model) - (mean - model).mean(axis=0)
    return 1.0 - float(np.sum(error**2)) / max(float(np.sum((mean - mean.mean(axis=0)) ** 2)), 1e-12)


def _blocks(log: BodyLog) -> np.ndarray:
    """Return the ticks of each complete block: one second of flight after a settling time."""
    size, warm = max(1, round(BLOCK / log.dt)), round(WARM_UP / log.dt)
    is_settled = np.convolve(log.valid, np.ones(warm + 1), mode="full")[: len(log.valid)] > warm
    result, run = list[np.ndarray](), 0
    for k, fine in enumerate(is_settled):
        run = run + 1 if fine else 0
        if run == size:
            result.append(np.arange(k - size + 1, k + 1))
            run = 0
    return np.array(result, dtype=int).reshape(-1, size)
