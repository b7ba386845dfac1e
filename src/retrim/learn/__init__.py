"""Learning from roll-outs and windows of flight: pure functions of arrays, without a clock."""

from .bptt import PolicyState as PolicyState
from .bptt import bptt as bptt
from .bptt import policy_gradient as policy_gradient
from .bptt import policy_loss as policy_loss
from .env import Env as Env
from .pretrain import pretrain as pretrain
from .residuals import EnsembleModel as EnsembleModel
from .residuals import FittedResidual as FittedResidual
from .residuals import ResidualModel as ResidualModel
from .residuals import Targets as Targets
from .residuals import residual_targets as residual_targets
from .rollout import Trajectory as Trajectory
from .rollout import rollout as rollout
from .window import Window as Window
