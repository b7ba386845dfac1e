"""A node that publishes the messages of its standard input: ``main`` of the process that a guardian writes to."""

import contextlib
import os
import signal
import sys
import time
from collections.abc import Callable

LISTENER_S = 5.0  # [s], longest wait for a subscription


def publish_frames(
    publish: Callable[[bytes], object], has_listener: Callable[[], bool], read: Callable[[int], bytes]
) -> None:
    """Wait for a listener, announce this on the standard output, and publish messages until the pipe is closed.

    Args:
        publish: Publishes a serialised message.
        has_listener: Whether another node has subscribed.
        read: Reads at most a number of bytes of the pipe: messages, each behind its length in four bytes.
    """
    until = time.monotonic() + LISTENER_S
    while not has_listener() and time.monotonic() < until:
        time.sleep(0.02)
    print("ready", flush=True)
    while len(head := read(4)) == 4:
        length = int.from_bytes(head, "little")
        if len(message := read(length)) == length:
            publish(message)


def stand_apart() -> None:
    """Ignore the signals that end a flight, and give up the priority and the cores that a link passes on.

    The threads of a node at a real-time priority would take the core from the flight. The end of the pipe ends this
    process.
    """
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    with contextlib.suppress(OSError, AttributeError):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        os.sched_setaffinity(0, range(os.cpu_count() or 1))


def main() -> None:
    """Publish on a topic; the words are the back end, the router, the topic, and the type of the messages."""
    from .backends import open_node
    from .message_type import message_type
    from .node import COMMAND

    stand_apart()
    backend, router, topic, name = sys.argv[1:]
    node = open_node(backend, (), router)
    publish = node.advertise(topic, message_type(name), COMMAND)
    publish_frames(publish, lambda: any(not each.publishes for each in node.endpoints(topic)), sys.stdin.buffer.read)
    time.sleep(0.1)  # until the last message has left
    node.close()
