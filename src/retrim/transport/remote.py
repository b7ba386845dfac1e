"""Buses between machines by name: ``zenoh:192.168.1.5:7447``, ``ros:192.168.1.5:11311``."""

from collections.abc import Mapping
from dataclasses import dataclass

from ..errors import ConfigError
from .network import NetworkBus

KINDS = ("zenoh", "ros")
LOOPBACK = ("127.0.0.1", "localhost")


@dataclass(frozen=True)
class Address:
    """Where a bus is."""

    kind: str
    host: str
    port: int

    @classmethod
    def of(cls, text: str) -> "Address":
        """Read an address.

        Raises:
            ConfigError: It is none.
        """
        kind, _, place = text.partition(":")
        host, _, port = place.rpartition(":")
        if kind not in KINDS or not host or not port.isdecimal() or not 1 <= int(port) <= 65535:
            raise ConfigError(f"{text!r} is no address of a bus; one is zenoh:HOST:PORT or ros:HOST:PORT")
        return cls(kind, host, int(port))

    @property
    def loopback(self) -> bool:
        """Whether it is on this machine only."""
        return self.host in LOOPBACK

    def join(self, capacities: Mapping[str, int], *, listen: bool) -> NetworkBus:
        """Join the bus.

        Args:
            capacities: Longest message of each topic [bytes].
            listen: Wait for others there; ROS 1 has a master who does.

        Raises:
            ConfigError: It cannot be joined.
        """
        if self.kind == "zenoh":
            from .zenoh import ZenohBus

            return ZenohBus(capacities, f"tcp/{self.host}:{self.port}", listen=listen)
        from .ros import RosBus

        return RosBus(capacities, f"http://{self.host}:{self.port}")
