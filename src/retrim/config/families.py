"""Build the vehicle family of a preset, and the flight components that only presets with a family use."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..control.actuator_tracking import ActuatorTracking
from ..control.belief_flight import IdentifiedFlight
from ..control.controller import AbstractController, PolicyController
from ..control.excitation import Excitation
from ..control.near_target import WEAK_REACH, NearTarget, safe_reach
from ..control.policy import AbstractPolicy
from ..control.resting import RestingController
from ..errors import ConfigError
from ..estimation.command_path import PathEstimator, ringing_of
from ..physics.path_family import Member, PathBelief, PathFamily
from ..tasks.task import AbstractTask
from .presets import Preset
from .tasks import find_task
from .vehicle_file import VehicleSpec
from .vehicles import make_vehicle

FILE_ERROR_FACTOR = 2.0  # assumed error factor of a delay or lag in a vehicle file
LEAST = 0.01  # [s]: assumed error of a short delay or lag


def make_family(preset: Preset) -> PathFamily | None:
    """Return the family of a preset, if it has one.

    Raises:
        ConfigError: A range is empty or impossible.
    """
    table = preset.family
    if table is None:
        return None
    try:
        return PathFamily.of(
            delay=table.delay,
            rate_lag=table.rate_lag,
            least_damping=table.least_damping,
            thrust_lag=table.thrust_lag,
            least_frequency=table.least_frequency,
        )
    except ValueError as error:
        raise ConfigError(f"preset {preset.name!r}: [family]: {error}") from error


def prior_belief(preset: Preset, family: PathFamily) -> PathBelief:
    """Return the prior belief about a vehicle, with an error factor of two for the values in the vehicle file.

    Args:
        preset: Preset whose vehicle may come from a vehicle file.
        family: Family of the preset.
    """
    vehicle = preset.vehicle
    unknown = PathBelief.unknown()
    if not isinstance(vehicle, VehicleSpec):
        return unknown
    (low_delay, high_delay), (low_lag, high_lag) = _interval(vehicle.command_delay), _interval(_lag(vehicle))
    low_thrust, high_thrust = _interval(vehicle.motor_tau)
    least, most = (0.0, 1.0)
    if vehicle.rate_damping is not None:
        damping = min(vehicle.rate_damping[:2])
        least, most = float(ringing_of(damping * FILE_ERROR_FACTOR)), float(ringing_of(damping / FILE_ERROR_FACTOR))
    ends = [
        family.coordinates(*(jnp.array(value) for value in values))
        for values in ((low_delay, low_lag, least, low_thrust), (high_delay, high_lag, most, high_thrust))
    ]
    return PathBelief.between(*ends)


def policy_controller(preset: Preset, task: AbstractTask, policy: AbstractPolicy) -> AbstractController[Any]:
    """Return a policy with the observation used in flight.

    Args:
        preset: Preset of the policy. Except in the paper's own loop, which flies in the world frame, the observed
            distance from the target is limited if the task permits it. A policy for a family is also shifted so that it
            commands hover at home, if the task rests there.
        task: Task of the flight.
        policy: Policy of the flight.
    """
    observation = task.observation_in_flight
    controller = PolicyController(observation, policy)
    if preset.family is not None and task.rests:
        controller = RestingController(observation, policy, task.home())
    if preset.adapt.frame == "world" or not task.approaches_target or not observation.measures_state:
        return controller
    reach = safe_reach(make_vehicle(preset.vehicle)) if preset.family is None else jnp.array(WEAK_REACH)
    return NearTarget(controller, task, reach)


def track_actuators(controller: AbstractController[Any], preset: Preset) -> AbstractController[Any]:
    """Return a controller that receives the current thrust and body rates if its preset is for a family of vehicles.

    Args:
        controller: Controller of a policy.
        preset: Preset of the policy.
    """
    family = make_family(preset)
    if family is None:
        return controller
    prior = prior_belief(preset, family)
    path = family.path(prior.centre)
    return ActuatorTracking(controller.with_vehicle(Member(path, prior)), path, preset.dt)


def identify_vehicle(controller: AbstractController[Any], preset: Preset) -> IdentifiedFlight:
    """Return a controller that receives the vehicle's parameters, which are identified in flight.

    Args:
        controller: Controller of a policy for a family; see :func:`track_actuators`.
        preset: Preset of the policy.

    Raises:
        ConfigError: The preset is for one vehicle.
    """
    family = make_family(preset)
    if family is None:
        raise ConfigError(
            f"preset {preset.name!r} is for one vehicle, and its policy does not use an identified one: use a preset "
            "with a table [family], such as hover/any"
        )
    prior = prior_belief(preset, family)
    return IdentifiedFlight(
        controller,
        PathEstimator.of(preset.dt),
        family,
        prior,
        declared_vehicle(preset),
        watches=not find_task(preset.task).has_reference,
        excitation=Excitation.of() if preset.family is not None and preset.family.excitation else None,
    )


def declared_vehicle(preset: Preset) -> Float[Array, "2"] | None:
    """Return the command delay and rate lag from the vehicle file [s], if the file states both."""
    vehicle = preset.vehicle
    if not isinstance(vehicle, VehicleSpec) or vehicle.command_delay is None or vehicle.rate_lag is None:
        return None
    return jnp.array([vehicle.command_delay, max(vehicle.rate_lag[:2])])


def _lag(vehicle: VehicleSpec) -> float | None:
    return None if vehicle.rate_lag is None else max(vehicle.rate_lag[:2])


def _interval(value: float | None) -> tuple[float, float]:
    """Return the interval of a time constant from a vehicle file [s]; unbounded if the file does not state it."""
    if value is None:
        return 0.0, jnp.inf
    return min(value / FILE_ERROR_FACTOR, max(value - LEAST, 0.0)), max(value * FILE_ERROR_FACTOR, value + LEAST)
