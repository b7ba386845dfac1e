"""PX4 messages of the release in RETRIM_PX4_MSGS."""

import os

from rclpy_types import class_for

from retrim.ros2.definitions import DEFINITIONS, NEWEST
from retrim.ros2.message_type import message_type

for _name in DEFINITIONS:
    if _name.startswith("px4_msgs/"):
        globals()[_name.rpartition("/")[2]] = class_for(message_type(_name, os.environ.get("RETRIM_PX4_MSGS", NEWEST)))
