"""Flight logs flown again: what the nominal model missed, how well that is foretold, and what the vehicle is."""

from .foretelling import Foretold as Foretold
from .foretelling import Protocol as Protocol
from .foretelling import foretell as foretell
from .identification import Identified as Identified
from .identification import identify as identify
from .predictors import learnt as learnt
from .predictors import yardsticks as yardsticks
from .rows import rows_of as rows_of
