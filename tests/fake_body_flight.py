"""A flight of a rate loop with known delay, lags and thrust map: onboard measurements without attitude and position."""

from dataclasses import dataclass

import numpy as np
from scipy.signal import cont2discrete, lfilter

from retrim.physics.state import STANDARD_GRAVITY

DT = 1e-3
IDLE = 0.055


@dataclass(frozen=True, eq=False)
class BodyFlight:
    """Body axes forward-left-up, one row per millisecond; it is a key by its identity, since arrays have no hash."""

    t: np.ndarray
    command: np.ndarray
    """Commanded rates [rad/s]."""
    rates: np.ndarray
    motors: np.ndarray
    """Shares of the full command, (n, 4)."""
    force: np.ndarray
    """Specific force [m/s^2]."""


@dataclass(frozen=True)
class Truth:
    """The parameters of the flight."""

    delay: float = 0.008
    lag: float = 0.030
    damping: float = 0.7
    yaw_lag: float = 0.05
    gain: float = 1.0
    hover: float = 0.3
    curve: float = 0.6
    thrust_lag: float = 0.04


def second_order(u, lag, damping, delay):
    """Return the second-order response to ``u`` with omega = 2 zeta / lag, delayed [ms]; exact for a held command."""
    w = 2.0 * damping / lag
    num, den, _ = cont2discrete(([w * w], [1.0, lag * w * w, w * w]), DT, method="zoh")
    late = np.concatenate([np.full(round(delay / DT), u[0]), u])[: len(u)]
    return lfilter(num.ravel(), den, late - u[0]) + u[0]


def first_order(u, lag):
    """Return the first-order response to ``u``."""
    decay = np.exp(-DT / lag)
    return lfilter([0.0, 1.0 - decay], [1.0, -decay], u - u[0]) + u[0]


def random_walk(rng, n, size, tau, every=10):
    """Return a mean-reverting random walk, held over ``every`` rows."""
    k, h = n // every + 1, DT * every
    decay = np.exp(-h / tau)
    return np.repeat(lfilter([np.sqrt(1.0 - decay**2)], [1.0, -decay], size * rng.normal(size=k)), every)[:n]


def fly_body(seconds=16.0, truth=Truth(), seed=0, noise=0.01):
    """Fly random rates and thrusts, with mild measurement noise."""
    rng, n = np.random.default_rng(seed), round(seconds / DT)
    command = np.stack([random_walk(rng, n, size, 0.15) for size in (2.0, 2.0, 1.2)], axis=1)
    shapes = ((truth.lag, truth.damping), (truth.lag, truth.damping), (truth.yaw_lag, truth.damping))
    rates = np.stack(
        [truth.gain * second_order(u, *shape, truth.delay) for u, shape in zip(command.T, shapes, strict=True)], axis=1
    )
    level = truth.hover * (1.0 + np.clip(random_walk(rng, n, 0.25, 0.5), -0.6, 0.9))
    mix = 0.05 * np.stack([random_walk(rng, n, 1.0, 0.1) for _ in range(4)], axis=1)
    motors = np.clip(level[:, None] + mix - mix.mean(axis=1, keepdims=True), IDLE, 1.0)
    share = ((1.0 - truth.curve) * motors + truth.curve * motors**2).mean(axis=1)
    full = STANDARD_GRAVITY / ((1.0 - truth.curve) * truth.hover + truth.curve * truth.hover**2)
    force = np.zeros((n, 3))
    force[:, 2] = full * first_order(share, truth.thrust_lag)
    force[:, :2] = 0.3 * np.stack([random_walk(rng, n, 1.0, 0.3) for _ in range(2)], axis=1)
    rates += noise * rng.normal(size=rates.shape)
    force += 20.0 * noise * rng.normal(size=force.shape)
    return BodyFlight(DT * np.arange(n), command, rates, motors, force)
