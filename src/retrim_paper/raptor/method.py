"""RAPTOR as a flight method: it replaces the rate controller of the plant ``bem`` and commands the motors."""

import dataclasses

from retrim.config.methods import MethodEntry, MethodRequest
from retrim.config.setup import Setup
from retrim.errors import ConfigError
from retrim.physics.bem import BemQuadrotor
from retrim.plants.plant import Plant
from retrim.plants.sim import SimPlant
from retrim.runtime.pilot import ControllerPilot, Pilot

from .passive import HoverController
from .plant import RaptorNet, RaptorQuadrotor


def add_raptor(setup: Setup, plant: Plant) -> SimPlant:
    """Return a plant whose vehicle is controlled by RAPTOR along a set-up's reference.

    Raises:
        ConfigError: The plant does not support motor commands, or has sensors, which RAPTOR does not use.
        PlantError: The package with the RAPTOR network is not installed.
    """
    if not isinstance(plant, SimPlant) or not isinstance(plant.simulation.model, BemQuadrotor):
        raise ConfigError("method 'raptor' commands motors, which only plant 'bem' accepts: fly it there")
    if plant.simulation.sensors is not None:
        raise ConfigError(
            "method 'raptor' reads the state on board, without noise or delay: fly it with sensors 'ideal'"
        )
    model = RaptorQuadrotor(plant.simulation.model, RaptorNet.load(), setup.flight_task.setpoint)
    plant.simulation = dataclasses.replace(plant.simulation, model=model)
    return plant


def _pilot(request: MethodRequest) -> Pilot:
    if not request.setup.env.task.observation.measures_state:
        raise ConfigError("method 'raptor' needs the measured state; a policy that observes keypoints receives none")
    return ControllerPilot(HoverController())


entry = MethodEntry(_pilot, "RAPTOR", on_board=add_raptor)
