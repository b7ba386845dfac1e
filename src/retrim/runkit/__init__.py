"""Provides the parts of every run: training, flights with scores, result files, provenance and the compile cache.

Lockstep flights, live flights and the evaluation share these parts. This package never prints.
"""

from .compile_cache import enable_compile_cache as enable_compile_cache
from .flights import Flight as Flight
from .flights import FlightSpec as FlightSpec
from .flying import fly_one as fly_one
from .run import Run as Run
from .training import nominal_error as nominal_error
from .training import train as train
