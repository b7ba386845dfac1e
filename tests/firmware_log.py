"""The response of a vehicle with given Betaflight settings, for comparison with a log, and flights with excitation."""

import math
import time
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from retrim.io.logs.blackbox_header import read_header
from retrim.physics.betaflight import D_SCALE, P_SCALE
from retrim.physics.rate_tuning import authority
from retrim.physics.state import STANDARD_GRAVITY

PLAIN = [
    *(f"set {term}_{axis} = 0" for term in ("i", "f") for axis in ("roll", "pitch", "yaw")),
    "set d_max_roll = 0", "set d_max_pitch = 0", "set anti_gravity_gain = 0",
    "set tpa_rate = 0", "set dterm_lpf1_dyn_min_hz = 0", "set dterm_lpf1_dyn_max_hz = 0",
    "set dterm_lpf1_static_hz = 0", "set dterm_lpf2_static_hz = 0",
]  # fmt: skip
"""A loop with P and D only and an unfiltered derivative: two settings define its response."""
LOGS = ["set blackbox_device = VIRTUAL", "set blackbox_sample_rate = 1/8"]


def compute_response(path, model):
    """Return lag [s] and damping ratio from the P and D settings of a log header, and the throttle at hover.

    Motors with the time constant tau and the authority A give the response A P / (tau s^2 + (1 + A D) s + A P).
    """
    vehicle, coefficient = model.vehicle, model.loop.thrust_map
    data = Path(path).read_bytes()
    values = read_header(Path(path), data, 0).values
    alpha, tau = np.asarray(authority(vehicle, coefficient).alpha), float(vehicle.motor_tau)
    lags, dampings = [], []
    for axis, name in enumerate(("rollPID", "pitchPID")):
        p, _, d = (float(x) for x in values[name].split(","))
        a, b = alpha[axis] * P_SCALE * p, alpha[axis] * D_SCALE * d
        lags.append((1.0 + b) / a)
        dampings.append((1.0 + b) / (2.0 * np.sqrt(a * tau)))
    speed = jnp.sqrt(vehicle.mass * STANDARD_GRAVITY / (4.0 * coefficient))
    return float(np.mean(lags)), float(np.mean(dampings)), float(vehicle.esc.throttle(speed))


def fly_random_rates(plant, seconds, seed=0):
    """Hold the position roughly, with random rates and thrusts in addition."""
    rng, home = np.random.default_rng(seed), np.array([0.0, 0.0, 50.0])
    plant.connect()
    plant.take_off(home, 0.0)
    plant.hold(time.monotonic() + 0.3)
    plant.send(np.array([STANDARD_GRAVITY, 0.0, 0.0, 0.0]))
    begin, turn, push = time.monotonic(), np.zeros(3), 0.0
    fast, slow = math.exp(-0.1), math.exp(-0.025)  # decay in 0.01 s with time constants of 0.1 s and 0.4 s
    while (t := time.monotonic() - begin) < seconds:
        s = plant.read()
        turn = fast * turn + math.sqrt(1.0 - fast**2) * rng.normal(size=3) * np.array([1.5, 1.5, 1.0])
        push = slow * push + math.sqrt(1.0 - slow**2) * rng.normal() * 2.0
        a = np.array([0.0, 0.0, STANDARD_GRAVITY]) - (s.p - home) - 1.5 * s.v
        omega = turn + 4.0 * s.R.T @ np.cross(s.R[:, 2], a / np.linalg.norm(a)) * np.array([1.0, 1.0, 0.0])
        plant.send(np.array([np.clip(a @ s.R[:, 2] + push, 2.0, 25.0), *np.clip(omega, -6.0, 6.0)]))
        plant.wait(begin + t + 0.01)
