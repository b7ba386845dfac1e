"""Provide estimators: pure functions of a state and a measurement, called once per tick."""

from .camera import Camera as Camera
from .pose_filter import PoseFilter as PoseFilter
