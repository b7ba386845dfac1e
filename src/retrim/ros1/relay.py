"""A node that publishes the attitude targets of its standard input: ``main`` of a process that a guardian writes to."""

import os
import sys

from ..ros2.relay import outlive_flight, publish_frames
from .attitude_target import attitude_target
from .node import join


def main() -> None:
    """Publish on a topic; the words are the address of the rosmaster and the topic."""
    outlive_flight()
    master, topic = sys.argv[1:]
    rospy, kind = join(master), attitude_target()
    publisher = rospy.Publisher(topic, kind, queue_size=10, tcp_nodelay=True)
    publish_frames(
        lambda data: publisher.publish(kind().deserialize(data)), lambda: publisher.get_num_connections() > 0,
        sys.stdin.buffer,
    )  # fmt: skip
    rospy.sleep(0.1)  # until the last message has left
    os._exit(0)  # threads of rospy can keep an interpreter from ending
