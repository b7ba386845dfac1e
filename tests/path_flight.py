"""An independent closed-loop flight of many vehicles at once in NumPy: the plant of the evidence document.

Point mass, second-order rate loop, first-order lag and gain of the thrust, transport delay, linear drag, steps
of 2 ms. A cautious PD controller with an observer of the disturbance flies to the origin.
"""

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

G, DT, H = 9.81, 0.02, 0.002
PER = round(DT / H)


class Sensors(NamedTuple):
    """Standard deviations, and the latency in steps."""

    position: float = 0.0
    velocity: float = 0.0
    attitude: float = 0.0
    gyro: float = 0.0
    accelerometer: float = 0.0
    dropout: float = 0.0
    late: bool = False


LEVELS = {
    "ideal": Sensors(),
    "mocap": Sensors(0.3e-3, 3e-3, 1e-3, 0.01, 0.1),
    "onboard": Sensors(0.6e-3, 6e-3, 2e-3, 0.02, 0.2, 0.01, True),
    "rough": Sensors(1e-3, 1e-2, 3e-3, 0.03, 0.3, 0.05, True),
}


class Vehicles(NamedTuple):
    """Parameters of each vehicle, (n,)."""

    delay: np.ndarray
    rate_lag: np.ndarray
    rate_damping: np.ndarray
    yaw_lag: np.ndarray
    thrust_gain: np.ndarray
    thrust_lag: np.ndarray


class Flights(NamedTuple):
    """Measurements and commands at each tick, (n, ticks, ...)."""

    p: np.ndarray
    R: np.ndarray
    v: np.ndarray
    omega: np.ndarray
    a: np.ndarray
    u: np.ndarray
    age: float


def random_vehicles(rng, n):
    lag = np.exp(rng.uniform(np.log(0.015), np.log(0.15), n))
    delay = H * np.round(rng.uniform(0.0, 0.06, n) / H)
    damping, gain = rng.uniform(0.4, 1.2, n), rng.uniform(0.6, 1.6, n)
    return Vehicles(delay, lag, damping, np.clip(2.0 * lag, 0.03, 0.3), gain, rng.uniform(0.015, 0.08, n))


def fly(rng, vehicles, sensors, seconds, excitation=None, later=None, change=np.inf, push=None, goal=None):
    """Fly from a random point 1 m away; ``excitation`` maps the time to an addition to each command.

    From ``change`` [s] on, the vehicles are those of ``later``. ``push`` maps the time to an acceleration, and ``goal``
    maps the time to the goal and its velocity.
    """
    n, ticks = len(vehicles.delay), round(seconds / DT)
    loops, late = _loops(vehicles), np.round(vehicles.delay / H).astype(int)
    p = rng.normal(size=(n, 3))
    p /= np.linalg.norm(p, axis=1, keepdims=True)
    R, v, w, wd, f = np.tile(np.eye(3), (n, 1, 1)), 0 * p, 0 * p, 0 * p, np.full(n, G)
    command = np.tile([G, 0.0, 0.0, 0.0], (n, ticks + 8, 1))
    slow = np.clip(0.09 / (vehicles.delay + vehicles.rate_lag + 0.03), 0.35, 1.0)[:, None]
    with_push, a_mean, half, last, rows = 0 * p, 0 * p, None, None, []

    def sample(before):
        tilt = Rotation.from_rotvec(sensors.attitude * rng.normal(size=(n, 3))).as_matrix()
        new = (p + sensors.position * rng.normal(size=(n, 3)), R @ tilt, v + sensors.velocity * rng.normal(size=(n, 3)))
        if before is None:
            return new
        gap = rng.random(n) < sensors.dropout
        return tuple(
            np.where(gap.reshape((n,) + (1,) * (x.ndim - 1)), old, x) for old, x in zip(before, new, strict=True)
        )

    for k in range(ticks):
        if k * DT >= change:
            vehicles = later
            loops, change = _loops(vehicles), np.inf
        last = half if sensors.late and half is not None else sample(last)
        omega, a = w + sensors.gyro * rng.normal(size=(n, 3)), a_mean + sensors.accelerometer * rng.normal(size=(n, 3))
        if rows:
            with_push += 0.08 * (a - (rows[-1][5][:, :1] * last[1][:, :, 2] - [0, 0, G]) - with_push)
        u = _pd(last if goal is None else _from_goal(last, *goal(k * DT)), with_push, slow)
        if excitation is not None:
            u = u + excitation(k * DT)
        rows.append((*last, omega, a, u))
        command[:, 8 + k] = u
        a_mean = 0.0
        for i in range(PER):
            at = np.maximum((k * PER + i - late) // PER, -8) + 8
            message = command[np.arange(n), at]
            before = w
            error = np.stack([w - message[:, 1:], wd], axis=2)
            shift = np.einsum("anij,naj->nai", loops, error)
            w, wd = shift[:, :, 0] + message[:, 1:], shift[:, :, 1]
            f_new = f + (vehicles.thrust_gain * message[:, 0] - f) * (1.0 - np.exp(-H / vehicles.thrust_lag))
            acceleration = 0.5 * (f + f_new)[:, None] * R[:, :, 2] - 0.3 * v - [0, 0, G]
            if push is not None:
                acceleration = acceleration + push((k * PER + i) * H)
            R = R @ Rotation.from_rotvec(0.5 * H * (before + w)).as_matrix()
            p, v, f = p + H * v + 0.5 * H**2 * acceleration, v + H * acceleration, f_new
            a_mean = a_mean + acceleration / PER
            if sensors.late and i == PER // 2 - 1:
                half = sample(half)
    p, R, v, omega, a, u = (np.stack(column, axis=1) for column in zip(*rows, strict=True))
    return Flights(p, R, v, omega, a, u, 0.5 * DT if sensors.late else 0.0)


def _from_goal(x, p, v):
    return x[0] - p, x[1], x[2] - v


def _pd(x, with_push, slow):
    p, R, v = x
    force = np.clip(-3.0 * slow**2 * p - 3.2 * slow * v, -4.0, 4.0) - with_push + [0, 0, G]
    c = np.einsum("ni,ni->n", force, R[:, :, 2])
    expected = np.einsum("nji,nj->ni", R, force / np.linalg.norm(force, axis=1, keepdims=True))
    turn = 6.0 * slow * np.stack([-expected[:, 1], expected[:, 0], -0.25 * R[:, 1, 0]], axis=1)
    return np.concatenate([np.clip(c, 3.0, 18.0)[:, None], np.clip(turn, -6.0, 6.0)], axis=1)


def _loops(vehicles):
    """Return the exact transition of (omega - omega_cmd, its derivative) over a step, (axes, n, 2, 2)."""
    result = []
    for lag in (vehicles.rate_lag, vehicles.rate_lag, vehicles.yaw_lag):
        natural = 2.0 * vehicles.rate_damping / lag
        A = np.zeros((len(lag), 2, 2))
        A[:, 0, 1], A[:, 1, 0], A[:, 1, 1] = 1.0, -(natural**2), -2.0 * vehicles.rate_damping * natural
        total = term = np.tile(np.eye(2), (len(lag), 1, 1))
        for k in range(1, 30):
            term = term @ A * H / k
            total = total + term
        result.append(total)
    return np.stack(result)


def doublets(t):
    """Return thrust and rate pulses of the first second."""
    if t >= 1.0:
        return np.zeros(4)
    periods, shifts = np.array([0.48, 0.32, 0.32, 0.40]), np.array([0.01, 0.01, 1.6, 0.01])
    return np.array([2.0, 1.0, 1.0, 0.6]) * np.sign(np.sin(2.0 * np.pi * t / periods + shifts))
