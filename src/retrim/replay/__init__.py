"""Replays flight logs: measures the nominal model's error, predicts this error, and identifies the vehicle."""

from .body_identification import BodyIdentification as BodyIdentification
from .body_identification import identify_body as identify_body
from .identification import IdentifiedVehicle as IdentifiedVehicle
from .identification import identify as identify
from .prediction import PredictionScore as PredictionScore
from .prediction import Protocol as Protocol
from .prediction import predict_log as predict_log
from .predictors import model_factory as model_factory
from .predictors import yardsticks as yardsticks
from .rows import rows_of as rows_of
