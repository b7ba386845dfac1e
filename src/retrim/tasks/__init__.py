"""What we want: starts, rewards, observations, errors."""

from .hover import Hover as Hover
from .observation import AbstractObservation as AbstractObservation
from .observation import StateObs as StateObs
from .task import AbstractTask as AbstractTask
from .task import huber as huber
