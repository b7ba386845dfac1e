"""On-board controllers that command the motors directly, instead of the rate controller of the vehicle."""

import dataclasses
from typing import TYPE_CHECKING

from ..errors import ConfigError
from ..physics.bem import BemQuadrotor
from ..plants.plant import Plant
from ..plants.raptor import RaptorNet, RaptorQuadrotor
from ..plants.sim import SimPlant

if TYPE_CHECKING:
    from .setup import Setup


def raptor(setup: "Setup", plant: Plant) -> SimPlant:
    """Return a plant whose vehicle is controlled by RAPTOR, along the reference of a set-up.

    Raises:
        ConfigError: The plant does not support motor commands, or has sensors, which RAPTOR does not use.
        PlantError: The package with the RAPTOR network is not installed.
    """
    if not isinstance(plant, SimPlant) or not isinstance(plant.simulation.model, BemQuadrotor):
        raise ConfigError("method 'raptor' commands motors, which plant 'bem' alone has: fly it there")
    if plant.simulation.sensors is not None:
        raise ConfigError(
            "method 'raptor' reads the state on board, without noise or delay: fly it with sensors 'ideal'"
        )
    model = RaptorQuadrotor(plant.simulation.model, RaptorNet.load(), setup.flown.wanted)
    plant.simulation = dataclasses.replace(plant.simulation, model=model)
    return plant
