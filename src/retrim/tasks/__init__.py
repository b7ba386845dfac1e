"""Tasks: starts, rewards, observations, termination and errors."""

from .abstract_reference import AbstractReference as AbstractReference
from .abstract_reference import TurnedReference as TurnedReference
from .hover import AbstractHover as AbstractHover
from .hover import Hover as Hover
from .hover import L2Hover as L2Hover
from .keypoints import Keypoints as Keypoints
from .observation import AbstractObservation as AbstractObservation
from .observation import StateObs as StateObs
from .occluded import OccludedKeypoints as OccludedKeypoints
from .preview import Preview as Preview
from .reference import Reference as Reference
from .reference import joined as joined
from .shapes import REFERENCES as REFERENCES
from .shapes import smooth_start as smooth_start
from .task import AbstractTask as AbstractTask
from .task import Start as Start
from .task import huber as huber
from .track import AbstractTrack as AbstractTrack
from .track import L2Track as L2Track
from .track import SharpTrack as SharpTrack
from .track import Track as Track
from .trajectory_csv import from_csv as from_csv
from .transition import Spliced as Spliced
from .transition import spliced as spliced
from .transition import transition_between as transition_between
