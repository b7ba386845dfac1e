"""Writes the vehicle of a retrim flight as a vehicle file."""

from pathlib import Path

import jax
import jax.numpy as jnp

from ..adapt.vehicles import estimate_path
from ..config.names import plain_from
from ..config.setup import Setup
from ..config.vehicle_file import VehicleSpec
from ..errors import ConfigError, LogError
from ..estimation.command_path import Estimate as PathParameter
from ..estimation.command_path import PathEstimator
from ..io.files import check_writable, read_bounded, write_whole
from ..runkit.flights import Flight, FlightSpec
from ..runtime.flight import Log
from .files import refusal_of
from .identification import Estimate, IdentifiedVehicle
from .vehicle import MARK, vehicle_toml

MEMORY = 1e4  # [s]: the vehicle does not change during a flight
LEAST = 1.0  # shortest flight [s]


def check_vehicle_file(path: Path | None, vehicle: str | None = None) -> None:
    """Check the file of ``--save-vehicle`` before the flight.

    Args:
        path: File to write, if any.
        vehicle: Vehicle of the flight, which may be a vehicle file; by default the training vehicle.

    Raises:
        ConfigError: The name does not end in .toml, the folder does not exist or cannot be written, or the file exists
            and is the vehicle of the flight or was not written by retrim.
    """
    if path is None:
        return
    if path.suffix != ".toml":
        raise ConfigError(f"--save-vehicle {path}: the name of a vehicle file must end with .toml")
    if not path.absolute().parent.is_dir():
        raise ConfigError(f"--save-vehicle {path}: folder {path.absolute().parent} does not exist; create it first")
    if path.exists():
        if vehicle is not None and Path(vehicle).exists() and path.samefile(vehicle):
            raise ConfigError(f"--save-vehicle {path}: is the file of --vehicle; choose another name")
        if not path.is_file() or not read_bounded(path, "").startswith(MARK.encode()):
            raise ConfigError(f"--save-vehicle {path}: exists, and is not an identified vehicle; choose another name")
    check_writable(path.absolute().parent, "--save-vehicle")


def write_flight_vehicle(
    flight: Flight, setup: Setup, path: Path | None, faults: list[str], folder: Path
) -> list[Path]:
    """Write the vehicle identified from a flight, and return the written files.

    Args:
        flight: Flight to identify the vehicle from.
        setup: Set-up of the policy; its vehicle is used if the flight's scenario has none.
        path: File to write, if any.
        faults: Receives a line if the vehicle cannot be identified or written, or cannot fly.
        folder: Folder of the flight's results, which the file names.
    """
    if path is None:
        return []
    try:
        spec = flight.spec.scenario.vehicle or setup.preset.vehicle
        write_whole(path, flight_vehicle_toml(flight.log, spec, _source_of(flight.spec, setup, folder)).encode())
    except (LogError, OSError) as error:
        faults.append(f"--save-vehicle {path}: {error}")
        return []
    if reason := refusal_of(path):
        faults.append(f"--save-vehicle {path}: the vehicle is identified, but cannot fly: {reason}")
    return [path]


def _source_of(spec: FlightSpec, setup: Setup, folder: Path) -> str:
    """Return the policy, the method and the results from which a flight is found again."""
    policy, method, place = map(plain_from, (setup.preset.name, spec.method, folder.resolve().name))
    return f"a flight of {policy} with {method}, seed {spec.seed}, start {spec.start}, in the folder {place}"


def flight_vehicle_toml(log: Log, spec: str | VehicleSpec, source: str) -> str:
    """Return a flight's vehicle as TOML, with the identified delay, lags and damping.

    All other values come from ``spec``.

    Args:
        log: The flight.
        spec: Vehicle of the flight.
        source: Description of the flight, for the comment.

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
    return vehicle_toml(result, spec, source)


def _estimate_of(each: PathParameter) -> Estimate | None:
    return Estimate(float(each.mean), float(each.low), float(each.high)) if bool(each.excited) else None
