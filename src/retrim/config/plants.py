"""Registry of plants. Each plant has its entry in its own module, which is imported when the plant is first used."""

from typing import Any

from ..plants.entry import PlantEntry
from .registry import Registry

PLANTS: Registry[PlantEntry] = Registry(
    "plant",
    example="module:name of a PlantEntry",
    expected="a function of a PlantRequest",
    accepts=lambda thing: callable(thing) or isinstance(thing, PlantEntry),
)
register_plant = PLANTS.register


def find_plant(name: str) -> tuple[PlantEntry, str]:
    """Return the entry of a plant, and the address that follows its name.

    Args:
        name: Registered name; name and address of a vehicle; or ``module:name`` of an entry, or of a function of a
            :class:`~retrim.plants.entry.PlantRequest`.

    Raises:
        ConfigError: There is no such plant, or the object is neither an entry nor a function.
    """
    kind, _, address = name.partition(":")
    if kind in PLANTS and PLANTS[kind].is_vehicle:
        return PLANTS[kind], address
    thing: Any = PLANTS.find(name)
    if isinstance(thing, PlantEntry):
        return thing, ""
    about = (thing.__doc__ or name).strip().splitlines()[0]
    entry = PlantEntry(thing, about, has_sensors=True, has_faults=True, has_thrust_error=True, has_delay=True)
    return entry, ""


def is_vehicle(plant: str) -> bool:
    """Return whether a plant is a link to a vehicle.

    Raises:
        ConfigError: There is no such plant.
    """
    return find_plant(plant)[0].is_vehicle


for _name, _place in {
    "bem": "retrim.plants.simulations:bem",
    "simple": "retrim.plants.simulations:simple",
    "second-order": "retrim.plants.simulations:second_order",
    "rotorpy": "retrim.plants.rotorpy:entry",
    "mujoco": "retrim.plants.mujoco:entry",
    "crazyflow": "retrim.plants.crazyflow:entry",
    "mavlink": "retrim.plants.bridges.mavlink:entry",
    "crazyflie": "retrim.plants.bridges.crazyflie:entry",
    "ros2": "retrim.plants.bridges.ros2:entry",
    "ros": "retrim.ros1.plant:entry",
    "msp": "retrim.plants.bridges.msp_plant:entry",
    "betaflight": "retrim.plants.bridges.betaflight:entry",
}.items():
    PLANTS.register_place(_name, _place)
