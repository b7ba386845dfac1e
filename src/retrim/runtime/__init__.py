"""Flights: pilots, the flight loop, its record, and learners on a clock."""

from .adaptive import AdaptivePilot as AdaptivePilot
from .adaptive import ScheduledLearner as ScheduledLearner
from .batch import batch_flight as batch_flight
from .events import Event as Event
from .events import Observer as Observer
from .events import stage_events as stage_events
from .flight import FlightStopped as FlightStopped
from .flight import Log as Log
from .flight import Recorder as Recorder
from .flight import fly as fly
from .learner import Learner as Learner
from .lockstep import LockstepLearner as LockstepLearner
from .pilot import ControllerPilot as ControllerPilot
from .pilot import FunctionPilot as FunctionPilot
from .pilot import Pilot as Pilot
