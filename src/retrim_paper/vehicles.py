"""Vehicles of the demonstration and of the result pages."""

from dataclasses import replace

import numpy as np

from retrim.config.vehicle_file import VehicleSpec
from retrim.physics.state import STANDARD_GRAVITY
from retrim.physics.vehicle import Vehicle, large, small

DELAY = 0.03  # [s], command delay of the slow quadrotor
THRUST_TO_WEIGHT = 1.8  # of the heavy quadrotor


def slow_quadrotor() -> VehicleSpec:
    """Return a quadrotor like the small one, but with body rates that lag by 100 ms (yaw: 200 ms)."""
    like = _spec("slow rate loop", small())
    return replace(like, rate_lag=(0.1, 0.1, 0.2), rate_damping=(0.8, 0.8, 0.8), command_delay=DELAY)


def heavy_quadrotor() -> VehicleSpec:
    """Return a quadrotor like the large one, but with a thrust of only 1.8 times its weight."""
    like = _spec("heavy", large())
    return replace(like, thrust_max=THRUST_TO_WEIGHT * STANDARD_GRAVITY * like.mass)


def _spec(name: str, like: Vehicle) -> VehicleSpec:
    inertia, rates, drag = (tuple(np.asarray(each).tolist()) for each in (like.inertia, like.omega_max, like.drag_area))
    return VehicleSpec(
        name=name,
        mass=float(like.mass),
        inertia=(inertia[0], inertia[1], inertia[2]),
        arm=(float(like.arm[0]), float(like.arm[1])),
        thrust_max=float(like.thrust_max),
        rates_max=(rates[0], rates[1], rates[2]),
        motor_tau=float(like.motor_tau),
        drag_area=(drag[0], drag[1], drag[2]),
    )
