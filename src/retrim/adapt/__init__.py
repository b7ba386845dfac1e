"""The loop: the only place with time, processes, input and output."""

from .adapter import Adapter as Adapter
from .adapter import AdaptState as AdaptState
from .lockstep import AdaptivePilot as AdaptivePilot
from .lockstep import Event as Event
from .lockstep import Schedule as Schedule
from .plant import ControllerPilot as ControllerPilot
from .plant import Log as Log
from .plant import Plant as Plant
from .plant import PlantError as PlantError
from .plant import Sample as Sample
from .plant import fly as fly
from .plants import SimPlant as SimPlant
from .sensing import Sensing as Sensing
