"""Plants: one file each. The packages that some of them need are imported when such a plant is made."""

from .crazyflow import CrazyflowPlant as CrazyflowPlant
from .mujoco import MujocoPlant as MujocoPlant
from .rotorpy import RotorpyPlant as RotorpyPlant
from .sim import SimPlant as SimPlant
