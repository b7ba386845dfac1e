"""Messages of mavros; RETRIM_OTHER_HASH makes them those of another version."""

import os

from rclpy_types import class_for

from retrim.ros2.message_type import message_type

AttitudeTarget = class_for(message_type("mavros_msgs/msg/AttitudeTarget"), os.environ.get("RETRIM_OTHER_HASH", ""))
