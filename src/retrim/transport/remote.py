"""Buses between machines by name: ``zenoh:192.168.1.5:7447``, ``ros:192.168.1.5:11311/quad1``."""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from ..errors import ConfigError
from .network import NetworkBus
from .session import GREETINGS, Session
from .shared_key import MAKING, VARIABLE, SharedKey, read_key

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
    shared: SharedKey | None = field(default=None, repr=False, compare=False)
    """Shared by those who may speak there; None: anybody may."""

    def __str__(self) -> str:
        """Return the text that :meth:`of` reads."""
        return f"{self.kind}:{self.host}:{self.port}{'/' if self.key else ''}{self.key}"

    @classmethod
    def of(cls, text: str, shared: SharedKey | None = None) -> "Address":
        """Read an address.

        Args:
            text: As ``zenoh:192.168.1.5:7447``.
            shared: Key of those who may speak there.

        Raises:
            ConfigError: It is none.
        """
        found = ADDRESS.fullmatch(text)
        if not found or found["kind"] not in KINDS or not 1 <= int(found["port"]) <= 65_535:
            raise ConfigError(
                f"{text!r} is no address of a bus; one is zenoh:HOST:PORT or ros:HOST:PORT, with /KEY for one of "
                "several vehicles there"
            )
        return cls(found["kind"], found["host"], int(found["port"]), found["key"] or "", shared)

    @property
    def loopback(self) -> bool:
        """Whether it is on this machine only."""
        return self.host in LOOPBACK

    def check_shared(self) -> None:
        """Raise :class:`ConfigError` if the address is beyond this machine, and there is no shared key."""
        if self.shared is None and not self.loopback:
            raise ConfigError(
                f"{self}: learners beyond this machine need a shared key: --key FILE or the variable {VARIABLE}, the "
                f"same at both ends; {MAKING}"
            )

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
        greeting, where = GREETINGS[0 if listen else 1], f"{self.host}:{self.port}"
        session = None if self.shared is None else Session(self.shared, self.key, greeting)
        capacities, writes = dict(capacities) | dict.fromkeys(GREETINGS, 0), (*writes, greeting)
        bus: NetworkBus
        if self.kind == "zenoh":
            from .zenoh import ZenohBus

            bus = ZenohBus(capacities, f"tcp/{where}", listen=listen, key=self.key, writes=writes, session=session)
        else:
            from .ros import RosBus

            bus = RosBus(capacities, f"http://{where}", key=self.key, writes=writes, session=session)
        if session is None:
            bus.publish(greeting, b"")  # so that an end with a key knows that this one has none
        return bus


def flights_at(texts: Sequence[str], key: Path | None) -> list[Address]:
    """Return where flights are to learn for.

    Args:
        texts: As ``zenoh:192.168.1.5:7447``.
        key: File with the key that the flights have, too; None: that of ``RETRIM_KEY``, if there is one.

    Raises:
        ConfigError: There is none, one of them is no address, or the key cannot be read.
    """
    if not texts:
        raise ConfigError("no address; one is zenoh:HOST:PORT or ros:HOST:PORT")
    shared = read_key(key)
    return [Address.of(text, shared) for text in texts]
