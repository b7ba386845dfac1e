"""The entry with which a plant registers itself, and the request from which it is built."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..physics.disturbance import Disturbance
from ..physics.vehicle import Vehicle
from .measurement_faults import AbstractMeasurementFault
from .plant import Plant, as_numpy
from .sensors import AbstractSensors

DELAY = 0.02  # [s]: default command delay of plants with a configurable delay


@dataclass(frozen=True)
class PlantRequest:
    """The parameters of a plant, taken from a scenario."""

    vehicle: Vehicle
    disturbance: Disturbance
    sensors: AbstractSensors[Any] | None
    thrust_error: float
    """Relative thrust error; 0.1 means 10 % more thrust than commanded."""
    dt: float
    """Control period [s]."""
    seed: int
    delay: float = DELAY
    """Command delay [s]."""
    address: str = ""
    """Address of the vehicle; if empty, the default address of the link."""
    fault: AbstractMeasurementFault | None = None
    """Measurement fault, if any."""

    @property
    def limits(self) -> tuple[np.ndarray, np.ndarray]:
        """Smallest and largest command [c, omega] of the vehicle."""
        low, high = (as_numpy(u).astype(float) for u in (self.vehicle.command_min, self.vehicle.command_max))
        return low, high


@dataclass(frozen=True)
class PlantEntry:
    """A kind of plant."""

    make: Callable[[PlantRequest], Plant]
    about: str
    """Short description of the simulated system."""
    own_vehicle: str | None = None
    """Name of the plant's built-in vehicle; by default, the plant can simulate any vehicle."""
    has_sensors: bool = False
    """Whether the plant supports sensor models."""
    has_faults: bool = False
    """Whether the plant supports measurement faults."""
    has_thrust_error: bool = False
    """Whether the plant supports an error of the thrust map."""
    has_delay: bool = False
    """Whether the plant supports a configurable command delay."""
    has_disturbance_state: bool = False
    """Whether the plant advances the states of disturbances that have one, such as a load on a cable."""
    is_vehicle: bool = False
    """Whether the plant is a link to a vehicle, which runs in real time and whose world cannot be disturbed. An address
    may follow the plant's name, e.g. ``mavlink:udp:127.0.0.1:14540``. Such a plant is a
    :class:`~retrim.plants.bridges.vehicle_plant.VehiclePlant`."""
    has_world: bool = False
    """Whether retrim simulates the world around the vehicle, so disturbances can be applied."""
    awaits: str = "the vehicle, which takes off"
    """Subject of the message while a vehicle is not at the start yet."""
    check_address: Callable[[str], object] | None = None
    """Function that raises ConfigError if the address after a vehicle's name is invalid, if there is such a check."""
    needs: Callable[[], object] | None = None
    """Function that raises an error if a required program or package is missing, called before training; by default, a
    plant has no requirements."""
