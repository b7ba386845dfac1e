"""Evaluation as a library: fleets of flights, sweeps, tables, pictures. This package never prints."""

from .cluster import Cluster as Cluster
from .fleet import Fleet as Fleet
from .gathering import Flights as Flights
from .metrics import rows as rows
