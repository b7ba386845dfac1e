"""Reads flight logs of other systems: CSV, NPZ, ULog of PX4, bags of ROS 1 and 2, MCAP."""

from .flight_log import FlightLog as FlightLog
from .flight_log import read_flight_log as read_flight_log
from .log_map import LogMap as LogMap
from .named_maps import read_map as read_map
