"""Evaluates policies with fleets of flights, sweeps, tables and pictures. This package never prints."""

from .cluster import Cluster as Cluster
from .executor import Flights as Flights
from .fleet import Fleet as Fleet
from .metrics import rows as rows
