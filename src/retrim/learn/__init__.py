"""How it improves: arrays in, arrays out, no clock."""

from .bptt import PolicyState as PolicyState
from .bptt import bptt as bptt
from .bptt import policy_gradient as policy_gradient
from .bptt import policy_loss as policy_loss
from .pretrain import pretrain as pretrain
from .residual import EnsembleResidual as EnsembleResidual
from .residual import ResidualState as ResidualState
from .residual import Window as Window
from .residual import ZeroResidual as ZeroResidual
from .residual import fit_residual as fit_residual
from .residual import residual_targets as residual_targets
from .rollout import Trajectory as Trajectory
from .rollout import rollout as rollout
