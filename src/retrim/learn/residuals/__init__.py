"""Models of the residual acceleration, one per file; each follows the protocol in :mod:`.model`."""

from .ensemble import EnsembleModel as EnsembleModel
from .ensemble import EnsembleResidual as EnsembleResidual
from .ensemble import EnsembleState as EnsembleState
from .ensemble import fit_ensemble as fit_ensemble
from .layered import LayeredModel as LayeredModel
from .layered import LayeredState as LayeredState
from .linear import LinearModel as LinearModel
from .linear import LinearState as LinearState
from .model import FittedResidual as FittedResidual
from .model import ResidualModel as ResidualModel
from .place import PlaceModel as PlaceModel
from .place import PlaceState as PlaceState
from .rates import RateFit as RateFit
from .rates import RateModel as RateModel
from .regression import RegressionModel as RegressionModel
from .regression import RegressionState as RegressionState
from .swing import SwingModel as SwingModel
from .swing import SwingState as SwingState
from .targets import Targets as Targets
from .targets import residual_targets as residual_targets
