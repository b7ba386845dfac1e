"""Reads and writes files that contain policies, deltas, or a flight's learned state."""

from .checkpoint import load_delta as load_delta
from .checkpoint import read_policy as read_policy
from .checkpoint import save_delta as save_delta
from .checkpoint import write_policy as write_policy
from .policies import load_learner_state as load_learner_state
from .policies import load_policy as load_policy
from .policies import save_learner_state as save_learner_state
from .policies import save_policy as save_policy
