"""A ROS 2 network in one process: messages are delivered immediately, in the publishing thread."""

from collections import defaultdict

from retrim.ros2.message_type import message_type
from retrim.ros2.node import SENSOR, Endpoint, Ros2Node


class FakeNetwork:
    """Topics and the nodes that use them."""

    def __init__(self):
        self.subscribers = defaultdict(list)
        self.ends = defaultdict(list)

    def node(self):
        return FakeNode(self)


class FakeNode(Ros2Node):
    """A node of the network; it does not receive its own messages."""

    backend = "fake"

    def __init__(self, network):
        self.network, self.qos, self.closed = network, {}, False

    def advertise(self, topic, kind, qos):
        self._add(topic, kind, qos, publishes=True)

        def publish(data):
            for node, take in self.network.subscribers[topic]:
                if node is not self and not node.closed:
                    take(data)

        return publish

    def subscribe(self, topic, kind, qos, take):
        self._add(topic, kind, qos, publishes=False)
        self.network.subscribers[topic].append((self, take))

    def endpoints(self, topic):
        return [end for node, end in self.network.ends[topic] if node is not self and not node.closed]

    def published_topics(self):
        names = {topic: [end for end in self.endpoints(topic) if end.publishes] for topic in list(self.network.ends)}
        return {topic: ends[0].type_name for topic, ends in names.items() if ends}

    def close(self):
        self.closed = True

    def _add(self, topic, kind, qos, *, publishes):
        self.qos[topic] = qos
        self.network.ends[topic].append((self, Endpoint(kind.name, kind.hash, publishes)))


class RemoteNode:
    """The other end: it publishes messages and stores those of other nodes."""

    def __init__(self, network):
        self.node, self.publishers, self.messages = network.node(), {}, defaultdict(list)

    def publish(self, topic, name, fill=lambda x: None, release="newest", **values):
        kind = message_type(name, release)
        if topic not in self.publishers:
            self.publishers[topic] = self.node.advertise(topic, kind, SENSOR)
        message = kind.new()
        for field, value in values.items():
            setattr(message, field, value)
        fill(message)
        self.publishers[topic](kind.encode(message))

    def subscribe(self, topic, name, take=None, release="newest"):
        kind = message_type(name, release)

        def keep(data):
            message = kind.decode(data)
            self.messages[topic].append(message)
            if take is not None:
                take(message)

        self.node.subscribe(topic, kind, SENSOR, keep)
