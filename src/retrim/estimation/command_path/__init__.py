"""Identify a vehicle's command path in flight: delay, lags, damping and gains, with their uncertainty."""

from .estimate import Estimate as Estimate
from .estimate import PathEstimate as PathEstimate
from .estimator import PathEstimator as PathEstimator
from .estimator import PathState as PathState
from .report import describe_path as describe_path
from .response import ringing_of as ringing_of
