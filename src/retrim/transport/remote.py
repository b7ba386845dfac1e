"""Open buses between machines by address: ``zenoh:192.168.1.5:7447``, ``ros2:42/quad1``, ``ros:192.168.1.5:11311``."""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from ..errors import ConfigError
from ..ros2.node import LARGEST_DOMAIN, is_local
from .network import NetworkBus
from .session import GREETINGS, Session
from .shared_key import KEY_COMMAND, VARIABLE, SharedKey, read_key

KINDS = ("zenoh", "ros")
ROS2 = "ros2"
LOOPBACK = ("127.0.0.1", "localhost")
DOMAIN = re.compile(r"ros2:(?P<domain>\d{1,3})(/(?P<key>\w+))?", re.ASCII)
ADDRESS = re.compile(r"(?P<kind>\w+):(?P<host>[^/]+):(?P<port>\d{1,5})(/(?P<key>\w+))?")


@dataclass(frozen=True)
class Address:
    """Address of a bus."""

    kind: str
    host: str
    """Machine; empty for a domain of ROS 2, whose members find each other."""
    port: int
    """Port, or domain of ROS 2."""
    key: str = ""
    """Key that selects one vehicle among several at the same address."""
    shared: SharedKey | None = field(default=None, repr=False, compare=False)
    """Shared key of all ends that may publish there; None if any end may publish."""

    def __str__(self) -> str:
        """Return the text that :meth:`of` reads."""
        where = f"{self.port}" if self.kind == ROS2 else f"{self.host}:{self.port}"
        return f"{self.kind}:{where}{'/' if self.key else ''}{self.key}"

    @classmethod
    def of(cls, text: str, shared: SharedKey | None = None) -> "Address":
        """Read an address.

        Args:
            text: For example ``zenoh:192.168.1.5:7447``.
            shared: Key of all ends that may publish there.

        Raises:
            ConfigError: The text is not an address.
        """
        if (domain := DOMAIN.fullmatch(text)) and int(domain["domain"]) <= LARGEST_DOMAIN:
            return cls(ROS2, "", int(domain["domain"]), domain["key"] or "", shared)
        result = ADDRESS.fullmatch(text)
        if not result or result["kind"] not in KINDS or not 1 <= int(result["port"]) <= 65_535:
            raise ConfigError(
                f"{text!r} is not an address of a bus; expected zenoh:HOST:PORT, ros2:DOMAIN or ros:HOST:PORT, "
                "with /KEY for one of several vehicles there"
            )
        return cls(result["kind"], result["host"], int(result["port"]), result["key"] or "", shared)

    @property
    def loopback(self) -> bool:
        """Whether the address can be reached only from this machine."""
        return is_local() if self.kind == ROS2 else self.host in LOOPBACK

    def check_shared(self) -> None:
        """Raise :class:`ConfigError` if other machines can reach the address and there is no shared key."""
        if self.shared is None and not self.loopback:
            raise ConfigError(
                f"{self}: learners beyond this machine need a shared key: --key FILE or the variable {VARIABLE}, the "
                f"same at both ends; {KEY_COMMAND}"
            )

    def join(self, capacities: Mapping[str, int], *, listen: bool, writes: Iterable[str] = ()) -> NetworkBus:
        """Join the bus.

        Args:
            capacities: Maximum length of a message, by topic [bytes].
            listen: Whether to wait at the address for other ends; ROS 1 has a master for this, and ROS 2 discovery.
            writes: Topics that this end writes. Readers are connected to these topics immediately. Readers of
                other topics are connected only by the first message, which may also be the last one.

        Raises:
            ConfigError: The bus cannot be joined.
        """
        greeting, where = GREETINGS[0 if listen else 1], f"{self.host}:{self.port}"
        session = None if self.shared is None else Session(self.shared, self.key, greeting)
        capacities, writes = dict(capacities) | dict.fromkeys(GREETINGS, 0), (*writes, greeting)
        bus: NetworkBus
        if self.kind == "zenoh":
            from .zenoh import ZenohBus

            bus = ZenohBus(capacities, f"tcp/{where}", listen=listen, key=self.key, writes=writes, session=session)
        elif self.kind == ROS2:
            from .ros2 import Ros2Bus

            bus = Ros2Bus(capacities, self.port, key=self.key, writes=writes, session=session)
        else:
            from ..ros1.bus import RosBus

            bus = RosBus(capacities, f"http://{where}", key=self.key, writes=writes, session=session)
        if session is None:
            bus.publish(greeting, b"")  # so that an end with a key detects that this one has no key
        return bus


def flights_at(texts: Sequence[str], key: Path | None) -> list[Address]:
    """Return the addresses of the flights to learn for.

    Args:
        texts: For example ``zenoh:192.168.1.5:7447``.
        key: File with the key that the flights also have; by default, the key in ``RETRIM_KEY``, if any.

    Raises:
        ConfigError: There is no address, an address is invalid, or the key cannot be read.
    """
    if not texts:
        raise ConfigError("no address; expected zenoh:HOST:PORT, ros2:DOMAIN or ros:HOST:PORT")
    shared = read_key(key)
    return [Address.of(text, shared) for text in texts]
