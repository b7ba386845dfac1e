"""Registry of vehicles, and functions that read vehicles from files."""

from collections.abc import Callable
from pathlib import Path

from ..errors import ConfigError
from ..physics.vehicle import Vehicle, kingfisher, large, small
from .registry import Registry
from .vehicle_file import VehicleSpec, check_flyable, read_vehicle

VEHICLES: Registry[Callable[[], Vehicle]] = Registry(
    "vehicle",
    example="a vehicle file, as my_quad.toml, or module:name",
    expected="a function that returns a Vehicle",
)
PUBLISHED = {"small": small, "large": large, "kingfisher": kingfisher}
for _name, _make in PUBLISHED.items():
    VEHICLES.register(_name, _make)

register_vehicle = VEHICLES.register


def is_published(vehicle: str | VehicleSpec) -> bool:
    """Return whether a vehicle is a published one, whose rate loop has been used in flight by others."""
    return isinstance(vehicle, str) and vehicle in PUBLISHED


def vehicle_from(name: str | VehicleSpec) -> str | VehicleSpec:
    """Return a vehicle in the form that presets and scenarios store: a valid name, or the content of its file.

    Raises:
        ConfigError: There is no such vehicle, or the vehicle file cannot be used.
    """
    if isinstance(name, VehicleSpec):
        return name
    if name.endswith(".toml"):
        return read_vehicle(Path(name))
    if (path := Path(name) / "vehicle.toml").is_file():
        raise ConfigError(f"vehicle {name!r} is a folder; state the file: {path}")
    VEHICLES.find(name)
    return name


def make_vehicle(vehicle: str | VehicleSpec | Vehicle) -> Vehicle:
    """Build a vehicle; a :class:`Vehicle` is returned unchanged.

    Raises:
        ConfigError: The vehicle does not exist, is physically impossible, or cannot be controlled by the rate loop.
    """
    if isinstance(vehicle, Vehicle):
        return vehicle
    try:
        result = vehicle_from(vehicle)
        built_vehicle = result.build() if isinstance(result, VehicleSpec) else VEHICLES.find(result)()
        if isinstance(built_vehicle, Vehicle) and not is_published(result):
            check_flyable(built_vehicle)
    except (ValueError, TypeError) as error:
        raise (
            error if isinstance(error, ConfigError) else ConfigError(f"vehicle {name_of(vehicle)}: {error}")
        ) from error
    if not isinstance(built_vehicle, Vehicle):
        raise ConfigError(
            f"vehicle {name_of(vehicle)!r} returns {type(built_vehicle).__name__}, expected a retrim.Vehicle"
        )
    return built_vehicle


def name_of(vehicle: str | VehicleSpec) -> str:
    """Return the vehicle's name for use in results."""
    return vehicle.name if isinstance(vehicle, VehicleSpec) else vehicle
