"""Plants: one file each."""

from .sim import SimPlant as SimPlant
