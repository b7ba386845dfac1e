"""Adaptation as pure functions and messages; :mod:`retrim.runtime` runs them on a clock."""

from .buffer import RollingBuffer as RollingBuffer
from .gate import Verdict as Verdict
from .gate import judge as judge
from .learner import OnlineLearner as OnlineLearner
from .learner_state import FitReport as FitReport
from .learner_state import LearnerState as LearnerState
from .optimisers import AbstractPolicyOptimiser as AbstractPolicyOptimiser
from .updates import PolicyUpdate as PolicyUpdate
from .updates import Rejection as Rejection
from .updates import ResidualUpdate as ResidualUpdate
from .updates import Skip as Skip
from .updates import Update as Update
from .updates import pack_update as pack_update
from .updates import unpack_update as unpack_update
from .worker import BatchUpdate as BatchUpdate
from .worker import Worker as Worker
from .worker import WorkerBatch as WorkerBatch
from .workers import PolicyWorker as PolicyWorker
from .workers import ResidualWorker as ResidualWorker
from .workers import make_worker as make_worker
