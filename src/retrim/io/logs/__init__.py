"""Reads flight logs: CSV, NPZ, PX4 ULog, Betaflight Blackbox, ArduPilot dataflash, ROS 1 and ROS 2 bags, and MCAP."""

from .body_log import BodyLog as BodyLog
from .body_map import BodyMap as BodyMap
from .flight_log import FlightLog as FlightLog
from .flight_log import read_flight_log as read_flight_log
from .flight_log import read_log as read_log
from .log_map import LogMap as LogMap
from .named_maps import read_map as read_map
