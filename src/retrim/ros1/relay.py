"""A node that publishes the attitude targets of its standard input: ``main`` of a process that a guardian writes to."""

import sys
import time

from ..ros2.relay import publish_frames, stand_apart
from .attitude_target import attitude_target
from .node import join


def main() -> None:
    """Publish on a topic; the words are the address of the rosmaster and the topic."""
    stand_apart()  # before threads start
    master, topic = sys.argv[1:]
    rospy, kind = join(master), attitude_target()
    publisher = rospy.Publisher(topic, kind, queue_size=10, tcp_nodelay=True)
    publish_frames(
        lambda data: publisher.publish(kind().deserialize(data)), lambda: publisher.get_num_connections() > 0,
        sys.stdin.buffer.read,
    )  # fmt: skip
    time.sleep(0.1)  # until the last message has left
