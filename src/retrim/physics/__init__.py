"""What the world does: pure, differentiable, unbatched; no networks, no randomness, no input or output."""

from .disturbance import Constant as Constant
from .disturbance import Disturbance as Disturbance
from .disturbance import Reversing as Reversing
from .dynamics import AbstractDynamics as AbstractDynamics
from .dynamics import Hybrid as Hybrid
from .dynamics import PointMass as PointMass
from .dynamics import Residual as Residual
from .dynamics import StraightThrough as StraightThrough
from .dynamics import f_a as f_a
from .rotors import Rotors as Rotors
from .state import STANDARD_GRAVITY as STANDARD_GRAVITY
from .state import Command as Command
from .state import State as State
from .state import StateDot as StateDot
from .vehicle import Vehicle as Vehicle
from .vehicle import large as large
from .vehicle import small as small
