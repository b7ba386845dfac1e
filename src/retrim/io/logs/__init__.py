"""Reads flight logs from other systems: CSV, NPZ, PX4 ULog, ROS 1 and ROS 2 bags, and MCAP."""

from .flight_log import FlightLog as FlightLog
from .flight_log import read_flight_log as read_flight_log
from .log_map import LogMap as LogMap
from .named_maps import read_map as read_map
