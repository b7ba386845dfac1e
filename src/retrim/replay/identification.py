"""Identifies the vehicle from a log: the thrust map, drag, command delay, and the lags of thrust and body rates.

The mean acceleration over a tick comes from the difference between velocities, and the mean body rate from the
difference between attitudes. Both are compared with delayed commands behind a first-order lag, over a grid of delays
and lags. For a given delay and lag, the other parameters follow from linear least squares. The intervals come from a
bootstrap over two-second blocks, because the errors of successive ticks are correlated.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ..errors import LogError
from ..estimation.command_path import Estimate as PathParameter
from ..estimation.command_path import PathEstimate
from ..io.logs import FlightLog
from ..io.logs.on_one_clock import UP
from .delayed_regression import DELAYS, LAGS, Channel, lowest
from .path_of_log import path_of_log
from .rows import acting_commands

BLOCK, DRAWS = 2.0, 200  # length of a block [s], and number of bootstrap samples
LEAST_BLOCKS = 4
PERCENTILES = (5.0, 95.0)  # percentiles at the ends of an interval
WARM_UP = 0.3  # [s], at the beginning of a piece of flight, where a lag depends on commands before the piece
LEAST_SPEED = 0.3  # [m/s], root-mean-square velocity along an axis below which drag is not observable


class Estimate(NamedTuple):
    """A value and its 90 % interval."""

    value: float
    low: float
    high: float

    def text(self, unit: str, scale: float = 1.0) -> str:
        """Return the estimate as text."""
        value, low, high = (scale * x for x in self)
        return f"{value:.3g}{unit and ' '}{unit} ({low:.3g} to {high:.3g})"


@dataclass(frozen=True)
class IdentifiedVehicle:
    """A vehicle's identified parameters; a parameter is None if the log does not determine it."""

    delay: Estimate | None
    """Command delay [s]."""
    thrust_gain: Estimate | None
    """Thrust per commanded thrust [-]."""
    thrust_offset: Estimate | None
    """Upward acceleration without a command [m/s^2]."""
    full_thrust: Estimate | None
    """Acceleration at full thrust [m/s^2], if the commanded thrust is a share of full thrust."""
    thrust_lag: Estimate | None
    """Thrust lag [s]."""
    rate_lag: Estimate | None
    """Common lag of the roll and pitch rates [s]."""
    rate_gain: Estimate | None
    """Body rate per commanded body rate [-]."""
    yaw_lag: Estimate | None
    """Yaw-rate lag [s]."""
    yaw_gain: Estimate | None
    drag: tuple[Estimate | None, Estimate | None, Estimate | None]
    """Linear drag along the body axes [1/s]."""
    unexplained: float
    """Root mean square of the unexplained acceleration over three axes [m/s^2]."""

    rate_damping: Estimate | None = None
    """Damping ratio of the roll and pitch rates; None if the rate loop is modelled as first order."""

    @property
    def known(self) -> bool:
        """Whether the log determines at least one parameter of the vehicle."""
        return any(isinstance(value, Estimate) for value in (*vars(self).values(), *self.drag))


def identify(log: FlightLog, *, seed: int = 0) -> IdentifiedVehicle:
    """Identify a vehicle from a flight.

    Args:
        log: The flight. More movement and rotation determine more parameters.
        seed: Seed for the bootstrap.

    Raises:
        LogError: The flight is too short.
    """
    blocks = blocks_of(log)
    thrust = _thrust(log, blocks)
    rates = {} if log.command is None else {
        name: _rates(log, log.command, blocks, axes) for name, axes in (("rates", [0, 1]), ("yaw", [2]))
    }  # fmt: skip
    channels = {name: channel for name, channel in {"thrust": thrust, **rates}.items() if channel.is_significant()}
    random = np.random.default_rng(seed)
    resamples = [random.integers(0, len(blocks), len(blocks)) for _ in range(DRAWS)]
    draws = [np.ones(len(blocks)), *(np.bincount(draw, minlength=len(blocks)).astype(float) for draw in resamples)]
    solutions = [_solve(channels, thrust, draw) for draw in draws]

    for each in solutions:
        each["full"] = each["thrust gain"] * (log.full_thrust or 0.0) + each["offset"]

    def of(name: str, is_known: bool) -> Estimate | None:
        values = [each[name] for each in solutions] if is_known else []
        return Estimate(values[0], *(float(q) for q in np.percentile(values[1:], PERCENTILES))) if is_known else None

    speeds = np.sqrt(np.mean(np.einsum("nji,nj->ni", log.R, log.v)[log.valid] ** 2, axis=0))
    x, y, z = (
        of(f"drag {axis}", bool(channels) and bool(fast > LEAST_SPEED))
        for axis, fast in zip("xyz", speeds, strict=True)
    )
    lift, turn, yaw = (name in channels for name in ("thrust", "rates", "yaw"))
    vehicle = IdentifiedVehicle(
        of("delay", bool(channels)), of("thrust gain", lift), of("offset", lift),
        of("full", lift and log.full_thrust is not None), of("thrust lag", lift), of("rates lag", turn),
        of("rates gain", turn), of("yaw lag", yaw), of("yaw gain", yaw), (x, y, z), solutions[0]["left"],
    )  # fmt: skip
    return _with_path(vehicle, path_of_log(log)) if turn else vehicle


def _with_path(vehicle: IdentifiedVehicle, path: PathEstimate) -> IdentifiedVehicle:
    """Return the identified vehicle, with the in-flight estimator's delay and lags where they are excited.

    That estimator models the damping and the noise of differences, but a vehicle file has a first-order lag. The delay
    and the lag are therefore those of the nearest first-order path. The thrust map and the drag still come from the
    regression, because they must be estimated together with the offset and all three drag coefficients.
    """
    if not (bool(path.delay.excited) and bool(path.rate_lag.excited)):
        return vehicle
    delay, lag = (float(x) for x in path.first_order())
    longer, share = delay - float(path.delay.mean), lag / float(path.rate_lag.mean)
    yaw, thrust = vehicle.yaw_lag, vehicle.thrust_lag
    if yaw is not None and bool(path.yaw_lag.excited):
        yaw = _scale(path.yaw_lag)
    if thrust is not None and bool(path.thrust_lag.excited):
        thrust = _scale(path.thrust_lag)
    ends = (max(0.0, float(end) + longer) for end in (path.delay.mean, path.delay.low, path.delay.high))
    rate_lag = _scale(path.rate_lag, share)
    return replace(vehicle, delay=Estimate(*ends), rate_lag=rate_lag, yaw_lag=yaw, thrust_lag=thrust)


def _scale(each: PathParameter, scale: float = 1.0) -> Estimate:
    return Estimate(*(scale * float(end) for end in (each.mean, each.low, each.high)))


def _solve(channels: dict[str, Channel], thrust: Channel, draw: np.ndarray) -> dict[str, float]:
    """Return the common delay, and each channel's lag and parameters, interpolated on the grid."""
    fits = {name: channel.sums.fit(draw) for name, channel in channels.items()}
    late = np.sum([misfit.min(axis=1) for misfit, _ in fits.values()], axis=0) if fits else np.zeros(len(DELAYS))
    d = int(np.argmin(late))
    result = {"delay": lowest(DELAYS, late, d)}
    for name, (misfit, theta) in {"thrust": thrust.sums.fit(draw), **fits}.items():
        k = int(np.argmin(misfit[d]))
        lag = lowest(LAGS, misfit[d], k)
        slopes = (np.gradient(theta[:, k], DELAYS, axis=0)[d], np.gradient(theta[d], LAGS, axis=0)[k])
        between = theta[d, k] + (result["delay"] - DELAYS[d]) * slopes[0] + (lag - LAGS[k]) * slopes[1]
        result |= {f"{name} lag": lag, f"{name} gain": float(between[0])}
        if name == "thrust":
            result |= {f"drag {axis}": float(between[1 + i]) for i, axis in enumerate("xyz")}
            count = thrust.sums.n @ draw
            result |= {"offset": float(between[6]), "left": float(np.sqrt(3.0 * np.exp(misfit[d, k] / count)))}
    return result


def blocks_of(log: FlightLog) -> np.ndarray:
    """Return the ticks of each complete block: two seconds of flight after a settling time.

    Raises:
        LogError: The flight is too short.
    """
    size, warm = 10 * max(1, round(0.1 * BLOCK / log.dt)), round(WARM_UP / log.dt)
    good = log.valid[:-1] & log.valid[1:]
    has_settled = np.convolve(good, np.ones(warm + 1), mode="full")[: len(good)] > warm
    result, run = [], 0
    for k, fine in enumerate(has_settled):
        run = run + 1 if fine else 0
        if run == size:
            result.append(np.arange(k - size + 1, k + 1))
            run = 0
    if len(result) < LEAST_BLOCKS:
        raise LogError(
            f"{len(result) * BLOCK:g} s of flight in one piece are left; identification needs "
            f"{LEAST_BLOCKS * BLOCK:g} s at least"
        )
    return np.array(result)


def _thrust(log: FlightLog, blocks: np.ndarray) -> Channel:
    """Return the thrust channel: a + g e3 = k c R e3 - R D R^T v + d, over each tick."""
    R, v = log.R[:-1], 0.5 * (log.v[1:] + log.v[:-1])
    axis = 0.5 * (log.R[1:] + log.R[:-1])[:, :, 2]
    drag = -R * np.einsum("nji,nj->ni", R, v)[:, None, :]
    push = np.broadcast_to(np.eye(3), R.shape)

    def features(c: np.ndarray) -> np.ndarray:
        return np.concatenate([(c[:, None] * axis)[:, :, None], drag, push], axis=2)

    a = np.diff(log.v, axis=0) / log.dt + UP
    return Channel.of(features, lambda delay, lag: acting_commands(log.c, log.dt, delay, lag)[:-1], a, blocks)


def _rates(log: FlightLog, command: np.ndarray, blocks: np.ndarray, axes: list[int]) -> Channel:
    """Return the channel for some axes: omega = k omega_cmd + bias, over each tick; the axes share the lag and gain."""
    from scipy.spatial.transform import Rotation  # local, because it takes as long to import as all of retrim

    omega = Rotation.from_matrix(np.swapaxes(log.R[:-1], 1, 2) @ log.R[1:]).as_rotvec() / log.dt
    bias = np.broadcast_to(np.eye(len(axes)), (len(omega), len(axes), len(axes)))

    def features(acting: np.ndarray) -> np.ndarray:
        return np.concatenate([acting[:, :, None], bias], axis=2)

    commands = command[:, axes]
    return Channel.of(
        features, lambda delay, lag: acting_commands(commands, log.dt, delay, lag)[:-1], omega[:, axes], blocks
    )
