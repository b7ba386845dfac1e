"""Plants, one per file; a package that only one plant needs is imported when that plant is created."""

from .camera_sensors import CameraSensors as CameraSensors
from .crazyflow import CrazyflowPlant as CrazyflowPlant
from .mujoco import MujocoPlant as MujocoPlant
from .plant import Measurement as Measurement
from .plant import Plant as Plant
from .plant import as_numpy as as_numpy
from .plant import check_command as check_command
from .rotorpy import RotorpyPlant as RotorpyPlant
from .sensors import AbstractSensors as AbstractSensors
from .sensors import SensorModel as SensorModel
from .sim import SimPlant as SimPlant
