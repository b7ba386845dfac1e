"""The scenario of a flight: plant, vehicle, sensors and disturbances."""

from dataclasses import dataclass, fields, replace

from ..errors import ConfigError, RetrimError
from ..physics.command_path import LONGEST_DELAY
from ..physics.disturbance import Disturbance, for_vehicle, stateful_parts
from ..physics.vehicle import Vehicle
from ..plants.entry import DELAY, PlantEntry, PlantRequest
from ..plants.plant import Plant
from .disturbances import disturbance
from .faults import NO_FAULT, measurement_fault
from .plants import find_plant
from .sensors import SENSORS, make_sensors
from .vehicle_file import VehicleSpec
from .vehicles import make_vehicle, name_of, vehicle_from

THRUST_ERROR = 0.035  # default relative thrust error of the plants


@dataclass(frozen=True)
class Scenario:
    """The plant, vehicle, sensors and disturbance of a flight, by name; validated on construction."""

    disturbance: str = "none"
    """Name, name with a size, or a sum such as ``wind=6+payload``."""
    plant: str = "bem"
    vehicle: str | VehicleSpec | None = None
    """Vehicle of the flight; by default the policy's training vehicle, or the plant's built-in vehicle."""
    sensors: str = "ideal"
    thrust_error: float = THRUST_ERROR
    """Relative thrust error; 0.1 means 10 % more than commanded. Only retrim's simulations support this error."""
    reference: str | None = None
    """Reference of a tracking policy; by default the training reference."""
    delay: float = DELAY
    """Command delay of the plant [s], which the policy does not receive. Only retrim's simulations support a delay."""
    fault: str = NO_FAULT
    """Measurement fault: a name, or a name with a size such as ``velocity-spikes=3``. Only retrim's simulations support
    faults."""

    def __post_init__(self) -> None:
        """Raise :class:`ConfigError` for an unknown name or an option that the plant does not support."""
        entry = self.entry
        SENSORS.find(self.sensors)
        has_state = bool(stateful_parts(disturbance(self.disturbance)))
        if self.vehicle is not None:
            if entry.own_vehicle is not None:
                raise ConfigError(
                    f"plant {self.plant!r} flies its own vehicle, {entry.own_vehicle}, not {name_of(self.vehicle)}"
                )
            object.__setattr__(self, "vehicle", vehicle_from(self.vehicle))
        if entry.check_address is not None:
            entry.check_address(find_plant(self.plant)[1])
        if entry.is_vehicle and not entry.has_world and self.disturbance != "none":
            raise ConfigError(
                f"plant {self.plant!r} is a vehicle, which cannot be disturbed by name: disturbance "
                f"{self.disturbance!r} must be none"
            )
        if has_state and not entry.has_disturbance_state:
            raise ConfigError(
                f"plant {self.plant!r} cannot carry a load on a cable; disturbance {self.disturbance!r} needs bem, "
                "simple or second-order"
            )
        if self.sensors != "ideal" and not entry.has_sensors:
            raise ConfigError(
                f"plant {self.plant!r} measures its true state; sensors {self.sensors!r} need bem, simple or "
                "second-order"
            )
        measurement_fault(self.fault)
        if self.fault != NO_FAULT and not entry.has_faults:
            raise ConfigError(
                f"plant {self.plant!r} has no faulty measurements; fault {self.fault!r} needs bem, simple or "
                "second-order"
            )
        if self.thrust_error != THRUST_ERROR and not entry.has_thrust_error:
            raise ConfigError(
                f"plant {self.plant!r} has its own thrust map; a thrust error needs bem, simple or second-order"
            )
        if self.delay != DELAY and not entry.has_delay:
            raise ConfigError(
                f"plant {self.plant!r} has its own command delay; a different one needs bem, simple or second-order"
            )
        if not 0.0 <= self.delay <= LONGEST_DELAY:
            raise ConfigError(f"delay {self.delay} s must be 0 to {LONGEST_DELAY:g} s")
        if not -0.5 <= self.thrust_error <= 1.0:
            raise ConfigError(f"thrust error {self.thrust_error} must be between -0.5 and 1")

    @property
    def entry(self) -> PlantEntry:
        """Registry entry of the plant."""
        return find_plant(self.plant)[0]

    def without_numbers(self) -> tuple["Scenario", tuple[str, ...]]:
        """Return the scenario without the numbers that leave the program unchanged: vehicle, delay and thrust error.

        Returns:
            The scenario without these numbers, and the names of the values that the vehicle file states.
        """
        numbers = tuple[str, ...]()
        vehicle = self.vehicle
        if isinstance(vehicle, VehicleSpec):
            numbers = tuple(field.name for field in fields(vehicle) if getattr(vehicle, field.name) is not None)
            vehicle = None
        return replace(self, vehicle=vehicle, delay=DELAY, thrust_error=THRUST_ERROR), numbers

    def vehicle_name(self, trained_for: str | VehicleSpec) -> str:
        """Return the name of the vehicle that a policy trained for ``trained_for`` flies."""
        return self.entry.own_vehicle or name_of(self.vehicle or trained_for)

    def make_vehicle(self, trained_for: str | VehicleSpec) -> Vehicle:
        """Build the vehicle that a policy trained for ``trained_for`` flies.

        A plant with a built-in vehicle does not report the vehicle's limits. For such a plant, the result is the
        training vehicle, whose limits the policy respects.
        """
        return make_vehicle(self.vehicle or trained_for)

    def make_disturbance(self, trained_for: str | VehicleSpec | Vehicle = "small", *, seed: int = 0) -> Disturbance:
        """Build the disturbance for the vehicle of the flight.

        Args:
            trained_for: Training vehicle of the policy, used unless the scenario has a vehicle.
            seed: Seed of the random parts of the disturbance.
        """
        return for_vehicle(disturbance(self.disturbance, seed), self._simulated_vehicle(trained_for))

    def _simulated_vehicle(self, trained_for: str | VehicleSpec | Vehicle) -> Vehicle:
        return make_vehicle(self.vehicle or ("small" if self.entry.own_vehicle else trained_for))

    def make(self, trained_for: str | VehicleSpec | Vehicle = "small", *, dt: float = 0.02, seed: int = 0) -> Plant:
        """Build the plant.

        Args:
            trained_for: Training vehicle of the policy, used unless the scenario has a vehicle.
            dt: Control period [s].
            seed: Seed of the disturbance and the sensors.

        Raises:
            PlantError: A package that the plant needs is not installed.
            ConfigError: The plant or its sensors do not support the control period.
        """
        entry = self.entry
        request = PlantRequest(
            self._simulated_vehicle(trained_for),
            self.make_disturbance(trained_for, seed=seed),
            make_sensors(self.sensors),
            self.thrust_error,
            dt,
            seed,
            self.delay,
            find_plant(self.plant)[1],
            measurement_fault(self.fault),
        )
        try:
            plant = entry.make(request)
        except RetrimError:
            raise
        except ValueError as error:
            raise ConfigError(
                f"plant {self.plant!r} with sensors {self.sensors!r} at dt = {dt:g} s: {error}"
            ) from error
        if not isinstance(plant, Plant):
            raise ConfigError(f"plant {self.plant!r} returns {type(plant).__name__}, expected a retrim.Plant")
        return plant
