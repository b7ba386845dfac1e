"""Build the command paths of a preset: those of its training model and of its declared plant.

| where | delay | lag |
|---|---|---|
| preset | `delay_ticks` for the model, `plant_delay_ticks` for the plant | `actuator_tau` |
| vehicle file | `command_delay`, for both | `rate_lag`, `rate_damping`, `motor_tau` |
| scenario | `delay`, for the simulated plant | that of the simulated vehicle |
"""

import jax.numpy as jnp

from ..errors import ConfigError
from ..physics.actuator_response import ActuatorResponse
from ..physics.command_path import LONGEST_DELAY, CommandPath
from ..physics.state import Command
from ..physics.step_response import step_responses
from ..physics.vehicle import Vehicle
from .loading import changed
from .presets import Preset
from .vehicle_file import VehicleSpec
from .vehicles import is_published

ACTUATOR_LAG = 0.033  # [s]: typical lag of a small quadrotor, for presets without a declared lag


def lag_of(preset: Preset, vehicle: Vehicle) -> Command | None:
    """Return the time constants of the thrust and body rates [s], or None for a model without lag.

    A vehicle with a known rate lag uses its own time constants. Published vehicles use the time constant of the
    preset. For other vehicles, the body rates use the rise times of the simulated rate loop, and the thrust uses the
    time constant of the motors.
    """
    if vehicle.rate_lag is not None:
        return Command(vehicle.motor_tau, vehicle.rate_lag)
    if not is_published(preset.vehicle):
        return Command(vehicle.motor_tau, jnp.array([about.rise for about in step_responses(vehicle)]))
    tau = preset.actuator_tau
    return None if tau is None else Command(jnp.array(tau), jnp.full(3, tau))


def response_of(preset: Preset, vehicle: Vehicle) -> ActuatorResponse | None:
    """Return the response of thrust and rates to commands in the preset's model, or None for a model without lag."""
    lag = lag_of(preset, vehicle)
    if lag is None:
        return None
    damping = vehicle.rate_damping
    return ActuatorResponse.of(lag.c, lag.omega, inverse_damping=0.0 if damping is None else 1.0 / damping)


def with_delay(preset: Preset) -> Preset:
    """Return the preset with the command delay from its vehicle file, if any, in the model and in the declared plant.

    Raises:
        ConfigError: The delay exceeds the largest number of ticks that a preset supports.
    """
    vehicle = preset.vehicle
    if not isinstance(vehicle, VehicleSpec) or vehicle.command_delay is None:
        return preset
    ticks = round(vehicle.command_delay / preset.dt)
    try:
        return changed(preset, delay_ticks=ticks, plant_delay_ticks=ticks)
    except ConfigError as error:
        raise ConfigError(
            f"vehicle {vehicle.name!r}: command_delay = {vehicle.command_delay:g} s is {ticks} ticks of "
            f"dt = {preset.dt:g} s; {error}"
        ) from error


def model_path(preset: Preset, vehicle: Vehicle) -> CommandPath:
    """Return the command path of a preset's training model."""
    return CommandPath.of(_delay(preset, preset.delay_ticks), response_of(preset, vehicle))


def declared_path(preset: Preset, vehicle: Vehicle) -> CommandPath:
    """Return the command path of the plant that a preset declares."""
    return CommandPath.of(_delay(preset, preset.plant_delay_ticks), response_of(preset, vehicle))


def _delay(preset: Preset, ticks: int) -> float:
    """Return the delay from the vehicle file, which need not be whole ticks, or the delay of the preset [s]."""
    vehicle = preset.vehicle
    delay = vehicle.command_delay if isinstance(vehicle, VehicleSpec) else None
    return ticks * preset.dt if delay is None else delay


def longest_delay(preset: Preset) -> float:
    """Return the longest delay that command queues can store [s]; this value is the same for all usual presets."""
    return max(LONGEST_DELAY, preset.dt * max(preset.delay_ticks, preset.plant_delay_ticks))
