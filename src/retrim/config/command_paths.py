"""The command paths that a preset describes: that of its model, and what it declares of the plant.

| where | delay | lag |
|---|---|---|
| preset | `delay_ticks` of the model, `plant_delay_ticks` of the plant | `actuator_tau` |
| vehicle file | `command_delay`, of both | `rate_lag`, `rate_damping`, `motor_tau` |
| scenario | `delay`, of the simulated plant | that of the simulated vehicle |
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

ACTUATOR_LAG = 0.033  # [s], where a preset declares none: what quadrotors of this size have


def lag_of(preset: Preset, vehicle: Vehicle) -> Command | None:
    """Return the time constants of thrust and rates [s], or None for a model without lag.

    They are the vehicle's where they are known. A published vehicle has those of the preset; the rates of any other one
    follow as those of its simulated rate loop do, and its thrust as its motors do.
    """
    if vehicle.rate_lag is not None:
        return Command(vehicle.motor_tau, vehicle.rate_lag)
    if not is_published(preset.vehicle):
        return Command(vehicle.motor_tau, jnp.array([about.rise for about in step_responses(vehicle)]))
    tau = preset.actuator_tau
    return None if tau is None else Command(jnp.array(tau), jnp.full(3, tau))


def response_of(preset: Preset, vehicle: Vehicle) -> ActuatorResponse | None:
    """Return how thrust and rates of a preset's model follow commands, or None if they follow at once."""
    lag = lag_of(preset, vehicle)
    if lag is None:
        return None
    damping = vehicle.rate_damping
    return ActuatorResponse.of(lag.c, lag.omega, inverse_damping=0.0 if damping is None else 1.0 / damping)


def delayed(preset: Preset) -> Preset:
    """Return a preset with the command delay of its vehicle, where its file says one, in the model and declared.

    Raises:
        ConfigError: It is more ticks than a preset may have.
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
    """Return the command path of a preset's model of training."""
    return CommandPath.of(_delay(preset, preset.delay_ticks), response_of(preset, vehicle))


def declared_path(preset: Preset, vehicle: Vehicle) -> CommandPath:
    """Return the command path that a preset declares of the plant."""
    return CommandPath.of(_delay(preset, preset.plant_delay_ticks), response_of(preset, vehicle))


def _delay(preset: Preset, ticks: int) -> float:
    """Return the delay of the vehicle file, which need not be whole ticks, or that of the preset [s]."""
    vehicle = preset.vehicle
    stated = vehicle.command_delay if isinstance(vehicle, VehicleSpec) else None
    return ticks * preset.dt if stated is None else stated


def longest_delay(preset: Preset) -> float:
    """Return the longest delay that queues of commands have room for [s]; the same for all usual presets."""
    return max(LONGEST_DELAY, preset.dt * max(preset.delay_ticks, preset.plant_delay_ticks))
