"""Configuration: presets, names and files, and the objects that they describe."""

from .disturbances import disturbance as disturbance
from .disturbances import register_disturbance as register_disturbance
from .faults import register_fault as register_fault
from .loading import changed as changed
from .loading import load as load
from .loading import overlaid as overlaid
from .methods import MethodEntry as MethodEntry
from .methods import MethodRequest as MethodRequest
from .methods import register_method as register_method
from .named_presets import PRESETS as PRESETS
from .plants import PlantEntry as PlantEntry
from .plants import PlantRequest as PlantRequest
from .plants import register_plant as register_plant
from .presets import Preset as Preset
from .references import register_reference as register_reference
from .residuals import ResidualRequest as ResidualRequest
from .residuals import register_residual as register_residual
from .scenario import Scenario as Scenario
from .sensors import register_sensor as register_sensor
from .setup import Setup as Setup
from .tasks import TaskEntry as TaskEntry
from .tasks import TaskRequest as TaskRequest
from .tasks import register_task as register_task
from .vehicle_file import VehicleSpec as VehicleSpec
from .vehicle_file import read_vehicle as read_vehicle
from .vehicles import register_vehicle as register_vehicle
