"""Provide a bus between machines over zenoh.

The peers use neither a broker nor discovery: one end listens, and the others connect. The module needs the extra
``zenoh``.
"""

from collections.abc import Iterable, Mapping
from typing import Any

from ..errors import ConfigError
from ..ros2.zenoh_node import open_session
from .network import NetworkBus
from .session import Session

PREFIX = "retrim"
BUFFER = 1  # messages of a topic that its writer keeps for late subscribers


class ZenohBus(NetworkBus):
    """One end of the bus."""

    def __init__(
        self,
        capacities: Mapping[str, int],
        endpoint: str,
        *,
        listen: bool,
        key: str = "",
        writes: Iterable[str] = (),
        session: Session | None = None,
    ) -> None:
        """Join a bus.

        Args:
            capacities: Maximum length of a message, by topic [bytes].
            endpoint: Endpoint, for example ``tcp/192.168.1.5:7447``.
            listen: Whether to wait at the endpoint for other ends; otherwise, the bus tries to connect to a listening
                end without a time limit.
            key: Key that selects one vehicle among several.
            writes: Topics that are written here; others are declared with their first message.
            session: Signs messages; None if messages are not signed.

        Raises:
            ConfigError: zenoh is not installed, or the bus cannot listen at the endpoint.
        """
        try:
            import zenoh
            from zenoh import ext as _ext
        except ImportError as error:
            raise ConfigError("a bus by zenoh needs zenoh: pip install eclipse-zenoh") from error
        ext: Any = _ext
        super().__init__(capacities, session)
        self._session = open_session(endpoint, listen, f"join at {endpoint!r}")
        cache = ext.CacheConfig(BUFFER)
        history = ext.HistoryConfig(detect_late_publishers=True, max_samples=BUFFER)
        # Messages are not dropped if the network is slow, because some topics carry only a single message.
        block, remote = zenoh.CongestionControl.BLOCK, zenoh.Locality.REMOTE
        prefix = f"{PREFIX}/{key}" if key else PREFIX
        self._declare: Any = lambda topic: ext.declare_advanced_publisher(
            self._session, f"{prefix}/{topic}", cache=cache, publisher_detection=True, congestion_control=block
        )
        self._publishers: dict[str, Any] = {topic: self._declare(topic) for topic in writes}
        self._subscribers = []
        for topic in capacities:
            where, listener = f"{prefix}/{topic}", self._listener(topic)
            result = ext.declare_advanced_subscriber(
                self._session, where, listener, history=history, allowed_origin=remote
            )
            self._subscribers.append(result)
        self._begin()

    def close(self) -> None:
        """Leave the bus."""
        self._end()
        self._session.close()

    def _send(self, topic: str, frame: bytes) -> None:
        if topic not in self._publishers:  # only the writer of a topic declares a publisher
            self._publishers[topic] = self._declare(topic)
        self._publishers[topic].put(frame)

    def _listener(self, topic: str) -> Any:
        return lambda sample: self._receive(topic, bytes(sample.payload))
