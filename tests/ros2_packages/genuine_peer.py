"""A simulated vehicle behind a genuine ROS 2 node: rclpy, rcl and Fast DDS from the package index.

The messages of nav_msgs and geometry_msgs are rclpy's own objects, which rclpy serialises; see rclpy_types for others.
"""

import importlib

from retrim.ros2.rclpy_node import RclpyNode
from retrim.testing import ros2_peer

STAND_INS = ("px4_msgs/", "mavros_msgs/")


class GenuineNode(RclpyNode):
    """A node that publishes objects of rclpy."""

    def advertise(self, topic, kind, qos):
        if kind.name.startswith(STAND_INS):
            return super().advertise(topic, kind, qos)
        package, middle, short = kind.name.split("/")
        cls = getattr(importlib.import_module(f"{package}.{middle}"), short)
        publisher = self._node.create_publisher(cls, topic, self._profile(qos))
        return lambda data: publisher.publish(_copied(kind.decode(data), cls()))

    def _check_installed(self, topic, kind):
        """Do nothing, since a peer may have a different version."""


def _copied(source, target):
    """Copy the fields of a message of rosbags to an object of rclpy."""
    for name in target.get_fields_and_field_types():
        value = getattr(source, name)
        if hasattr(value, "__msgtype__"):
            _copied(value, getattr(target, name))
        else:
            setattr(target, name, value)
    return target


if __name__ == "__main__":
    ros2_peer.fly(GenuineNode(), ros2_peer.parse())
