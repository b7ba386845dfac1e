"""Replay of flight logs: error of the nominal model, prediction of that error, and identification of the vehicle."""

from .foretelling import Foretold as Foretold
from .foretelling import Protocol as Protocol
from .foretelling import foretell as foretell
from .identification import Identified as Identified
from .identification import identify as identify
from .predictors import learnt as learnt
from .predictors import yardsticks as yardsticks
from .rows import rows_of as rows_of
