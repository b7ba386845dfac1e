"""What commands the motors of a vehicle itself, in the place of its rate controller."""

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
    """Return a plant whose vehicle RAPTOR flies, along the reference of a set-up.

    Raises:
        ConfigError: The plant has no motors that can be commanded, or sensors that RAPTOR would not look at.
        PlantError: The package of its network is not installed.
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
