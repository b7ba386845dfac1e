"""Writes the vehicle of a retrim flight as a vehicle file."""

import jax
import jax.numpy as jnp

from ..adapt.vehicles import estimate_path
from ..config.setup import Setup
from ..errors import LogError
from ..estimation.command_path import Estimate as PathParameter
from ..estimation.command_path import PathEstimator
from ..runtime.flight import Log
from .identification import Estimate, IdentifiedVehicle
from .vehicle import vehicle_toml

MEMORY = 1e4  # [s]: the vehicle does not change during a flight
LEAST = 1.0  # shortest flight [s]


def flight_vehicle_toml(log: Log, setup: Setup, name: str) -> str:
    """Return a flight's vehicle as TOML, with the identified delay, lags and damping.

    All other values come from the preset.

    Args:
        log: The flight.
        setup: Set-up of the policy that flew the vehicle.
        name: Name of the flight, for the comment.

    Raises:
        LogError: The flight is too short, or the vehicle moves too little to be identified.
    """
    ticks = len(log.t) - 1
    if ticks * log.dt < LEAST:
        raise LogError(f"the flight must be at least {LEAST:g} s long to identify its vehicle, got {log.t[-1]:.2f} s")
    estimator = PathEstimator.of(log.dt, memory=MEMORY)
    path = jax.jit(estimate_path)(estimator, jax.tree.map(jnp.asarray, log.window(ticks)))
    result = IdentifiedVehicle(
        delay=_estimate_of(path.delay),
        thrust_gain=_estimate_of(path.thrust_gain),
        thrust_offset=None,
        full_thrust=None,
        thrust_lag=_estimate_of(path.thrust_lag),
        rate_lag=_estimate_of(path.rate_lag),
        rate_gain=_estimate_of(path.rate_gain),
        yaw_lag=_estimate_of(path.yaw_lag),
        yaw_gain=_estimate_of(path.yaw_gain),
        drag=(None, None, None),
        unexplained=0.0,
        rate_damping=_estimate_of(path.rate_damping),
    )
    if result.delay is None and result.rate_lag is None and result.thrust_lag is None:
        raise LogError("the flight moves too little to identify its vehicle: fly from farther away, or under a push")
    return vehicle_toml(result, setup, name)


def _estimate_of(each: PathParameter) -> Estimate | None:
    return Estimate(float(each.mean), float(each.low), float(each.high)) if bool(each.excited) else None
