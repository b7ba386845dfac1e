"""MAVROS messages; RETRIM_OTHER_HASH gives them the hashes of a different version."""

import os

from rclpy_types import class_for

from retrim.ros2.message_type import message_type

AttitudeTarget = class_for(message_type("mavros_msgs/msg/AttitudeTarget"), os.environ.get("RETRIM_OTHER_HASH", ""))
