"""retrim: re-train neural flight policies in seconds, in flight.

Pretrain a policy in a differentiable simulator, fly it on a plant, learn from the last seconds of flight what the
simulator missed, re-train the policy in the corrected simulator, and swap it in, while the vehicle keeps flying.
"""

import os
import sys

# Before jax is first imported: its compile cache otherwise reports, for every program it loads, machine features that
# differ only in name. Set the variable yourself to see XLA's log.
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
# Before scipy is first imported: the plant crazyflow needs it, and says so where it comes too late.
if "scipy" not in sys.modules:
    os.environ.setdefault("SCIPY_ARRAY_API", "1")

from .adapt import Adapter as Adapter
from .adapt import AdaptivePilot as AdaptivePilot
from .adapt import AdaptState as AdaptState
from .adapt import ControllerPilot as ControllerPilot
from .adapt import Log as Log
from .adapt import Plant as Plant
from .adapt import PlantError as PlantError
from .adapt import Sample as Sample
from .adapt import Schedule as Schedule
from .adapt import SimPlant as SimPlant
from .adapt import fly as fly
from .checkpoint import PolicyError as PolicyError
from .checkpoint import load_delta as load_delta
from .checkpoint import load_policy as load_policy
from .checkpoint import save_delta as save_delta
from .checkpoint import save_policy as save_policy
from .control import AbstractController as AbstractController
from .control import LoraPolicy as LoraPolicy
from .control import Policy as Policy
from .control import PolicyController as PolicyController
from .learn import EnsembleResidual as EnsembleResidual
from .learn import PolicyState as PolicyState
from .learn import ResidualState as ResidualState
from .learn import Trajectory as Trajectory
from .learn import Window as Window
from .learn import bptt as bptt
from .learn import fit_residual as fit_residual
from .learn import policy_loss as policy_loss
from .learn import pretrain as pretrain
from .learn import residual_targets as residual_targets
from .learn import rollout as rollout
from .physics import AbstractDynamics as AbstractDynamics
from .physics import Bem as Bem
from .physics import Command as Command
from .physics import Constant as Constant
from .physics import Hybrid as Hybrid
from .physics import PointMass as PointMass
from .physics import Push as Push
from .physics import Reversing as Reversing
from .physics import Rotors as Rotors
from .physics import State as State
from .physics import StraightThrough as StraightThrough
from .physics import Vehicle as Vehicle
from .presets import PRESETS as PRESETS
from .presets import Preset as Preset
from .presets import PresetError as PresetError
from .tasks import AbstractObservation as AbstractObservation
from .tasks import AbstractTask as AbstractTask
from .tasks import Hover as Hover
from .tasks import Reference as Reference
from .tasks import StateObs as StateObs
from .tasks import from_csv as from_csv
