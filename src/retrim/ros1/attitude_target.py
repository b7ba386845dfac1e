"""The message type mavros_msgs/AttitudeTarget, made from its fields, because Debian does not provide mavros."""

from typing import Any

from .node import system_module

ATTITUDE_TARGET = """std_msgs/Header header
uint8 type_mask
uint8 IGNORE_ROLL_RATE = 1
uint8 IGNORE_PITCH_RATE = 2
uint8 IGNORE_YAW_RATE = 4
uint8 IGNORE_THRUST = 64
uint8 IGNORE_ATTITUDE = 128
geometry_msgs/Quaternion orientation
geometry_msgs/Vector3 body_rate
float32 thrust
================================================================================
MSG: std_msgs/Header
uint32 seq
time stamp
string frame_id
================================================================================
MSG: geometry_msgs/Quaternion
float64 x
float64 y
float64 z
float64 w
================================================================================
MSG: geometry_msgs/Vector3
float64 x
float64 y
float64 z
"""
"""Fields of mavros_msgs/AttitudeTarget; nodes compare their checksum."""


def attitude_target() -> Any:
    """Return the type mavros_msgs/AttitudeTarget.

    Raises:
        ConfigError: genpy is not installed.
    """
    message_class = system_module("genpy.dynamic").generate_dynamic("mavros_msgs/AttitudeTarget", ATTITUDE_TARGET)
    return message_class["mavros_msgs/AttitudeTarget"]
