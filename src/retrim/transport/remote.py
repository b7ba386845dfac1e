"""Buses between machines by name: ``zenoh:192.168.1.5:7447``, ``ros:192.168.1.5:11311/quad1``."""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from ..errors import ConfigError
from .network import NetworkBus

KINDS = ("zenoh", "ros")
LOOPBACK = ("127.0.0.1", "localhost")
ADDRESS = re.compile(r"(?P<kind>\w+):(?P<host>[^/]+):(?P<port>\d{1,5})(/(?P<key>\w+))?")


@dataclass(frozen=True)
class Address:
    """Where a bus is."""

    kind: str
    host: str
    port: int
    key: str = ""
    """Of one vehicle among several that share the place."""

    def __str__(self) -> str:
        """Return the text that :meth:`of` reads."""
        return f"{self.kind}:{self.host}:{self.port}{'/' if self.key else ''}{self.key}"

    @classmethod
    def of(cls, text: str) -> "Address":
        """Read an address.

        Raises:
            ConfigError: It is none.
        """
        found = ADDRESS.fullmatch(text)
        if not found or found["kind"] not in KINDS or not 1 <= int(found["port"]) <= 65_535:
            raise ConfigError(
                f"{text!r} is no address of a bus; one is zenoh:HOST:PORT or ros:HOST:PORT, with /KEY for one of "
                "several vehicles there"
            )
        return cls(found["kind"], found["host"], int(found["port"]), found["key"] or "")

    @property
    def loopback(self) -> bool:
        """Whether it is on this machine only."""
        return self.host in LOOPBACK

    def join(self, capacities: Mapping[str, int], *, listen: bool, writes: Iterable[str] = ()) -> NetworkBus:
        """Join the bus.

        Args:
            capacities: Longest message of each topic [bytes].
            listen: Wait for others there; ROS 1 has a master who does.
            writes: Topics that this end writes. Readers are connected to them at once, and not with the first message,
                which may be the last one, too.

        Raises:
            ConfigError: It cannot be joined.
        """
        if self.kind == "zenoh":
            from .zenoh import ZenohBus

            return ZenohBus(capacities, f"tcp/{self.host}:{self.port}", listen=listen, key=self.key, writes=writes)
        from .ros import RosBus

        return RosBus(capacities, f"http://{self.host}:{self.port}", key=self.key, writes=writes)
