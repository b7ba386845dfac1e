"""Model vehicles with pure, differentiable, unbatched functions that use neither networks nor input and output.

Random keys are used only at construction.
"""

from . import precision as precision
from .actuator_response import ActuatorResponse as ActuatorResponse
from .actuator_response import ActuatorState as ActuatorState
from .actuators import LaggedModel as LaggedModel
from .bem import BemQuadrotor as BemQuadrotor
from .betaflight import Betaflight as Betaflight
from .command_path import CommandPath as CommandPath
from .command_path import CommandQueue as CommandQueue
from .command_path import PathState as PathState
from .disturbance import Constant as Constant
from .disturbance import Disturbance as Disturbance
from .disturbance import Push as Push
from .disturbance import RandomWalk as RandomWalk
from .disturbance import Reversing as Reversing
from .disturbance import SumOfDisturbances as SumOfDisturbances
from .downwash import Downwash as Downwash
from .dynamics import AbstractDynamics as AbstractDynamics
from .dynamics import Hybrid as Hybrid
from .dynamics import PointMass as PointMass
from .dynamics import Residual as Residual
from .dynamics import StraightThrough as StraightThrough
from .dynamics import f_a as f_a
from .effects import ExternalEffects as ExternalEffects
from .faults import BatterySag as BatterySag
from .faults import Payload as Payload
from .faults import WeakRotor as WeakRotor
from .propeller import Propeller as Propeller
from .propeller import five_inch as five_inch
from .propeller import three_inch as three_inch
from .proximity import Ceiling as Ceiling
from .proximity import TableEdge as TableEdge
from .rotors import LinearDragQuadrotor as LinearDragQuadrotor
from .second_order import SecondOrderQuadrotor as SecondOrderQuadrotor
from .slung_load import LoadState as LoadState
from .slung_load import SlungLoad as SlungLoad
from .state import STANDARD_GRAVITY as STANDARD_GRAVITY
from .state import Command as Command
from .state import State as State
from .state import StateDot as StateDot
from .substep import AbstractSubstepDynamics as AbstractSubstepDynamics
from .substep import RotorState as RotorState
from .vehicle import Esc as Esc
from .vehicle import Vehicle as Vehicle
from .vehicle import kingfisher as kingfisher
from .vehicle import large as large
from .vehicle import small as small
from .vehicle import with_payload as with_payload
from .wind import Dryden as Dryden
from .wind import Fan as Fan
from .wind import SteadyWind as SteadyWind
from .wind import Turbulence as Turbulence
