"""What we want: starts, rewards, observations, errors."""

from .camera import Camera as Camera
from .hover import AbstractHover as AbstractHover
from .hover import Hover as Hover
from .hover import SharpHover as SharpHover
from .keypoints import Keypoints as Keypoints
from .observation import AbstractObservation as AbstractObservation
from .observation import StateObs as StateObs
from .preview import Preview as Preview
from .reference import REFERENCES as REFERENCES
from .reference import Reference as Reference
from .reference import from_csv as from_csv
from .reference import joined as joined
from .task import AbstractTask as AbstractTask
from .task import Start as Start
from .task import huber as huber
from .track import AbstractTrack as AbstractTrack
from .track import SharpTrack as SharpTrack
from .track import Track as Track
