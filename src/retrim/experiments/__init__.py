"""Experiments as a library: training, fleets of flights, sweeps, tables, pictures. This package never prints."""

from .cluster import Cluster as Cluster
from .compile_cache import enable_compile_cache as enable_compile_cache
from .fleet import Fleet as Fleet
from .flights import Flight as Flight
from .flights import FlightSpec as FlightSpec
from .flying import fly_one as fly_one
from .gathering import Flights as Flights
from .metrics import rows as rows
from .run import Run as Run
from .training import nominal_error as nominal_error
from .training import train as train
