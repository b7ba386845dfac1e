"""Endpoints for an autopilot's bytes: a UDP port, a TCP connection or a serial line."""

import contextlib
import select
import socket
import time
from collections.abc import Callable, Sequence
from typing import Any, Protocol, runtime_checkable

from ...errors import ConfigError, PlantError
from ..extras import import_extra

LONGEST = 65_535
FORMS = {
    "udp": "udp:HOST:PORT, as udp:127.0.0.1:14540",
    "tcp": "tcp:HOST:PORT, as tcp:127.0.0.1:5761",
    "serial": "serial:DEVICE:BAUD, as serial:/dev/ttyACM0:921600",
}
CLOSED_WAIT_S = 1e-3  # [s] of a read after the other end has closed, since select then returns at once
NAP_S = 0.02  # [s], longest time between two calls of the periodic work


@runtime_checkable
class Endpoint(Protocol):
    """One end of a link; the methods do not block."""

    def fileno(self) -> int:
        """Return the descriptor that becomes readable when data has arrived."""
        ...

    def receive(self) -> tuple[bytes, Any] | None:
        """Return received data and its sender; None if there is no new data."""
        ...

    def send(self, data: bytes, to: Any) -> None:
        """Send data to the sender of earlier data; data that cannot be sent is lost, as on any link."""
        ...

    def close(self) -> None:
        """Close the port; idempotent."""
        ...


class UdpEndpoint:
    """A UDP port that an autopilot sends to."""

    def __init__(self, host: str, port: int) -> None:
        """Open the port.

        Raises:
            PlantError: The port cannot be opened.
        """
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.bind((host, port))
        except (OSError, OverflowError) as error:
            self._socket.close()
            raise PlantError(f"udp:{host}:{port} cannot be opened: {error}") from error
        self._socket.setblocking(False)

    def fileno(self) -> int:
        """Return the socket's descriptor."""
        return self._socket.fileno()

    def receive(self) -> tuple[bytes, Any] | None:
        """Return a datagram and its sender; None if there is no new datagram."""
        try:
            return self._socket.recvfrom(LONGEST)
        except OSError:  # no data, or the receiver of an earlier datagram no longer exists
            return None

    def send(self, data: bytes, to: Any) -> None:
        """Send a datagram."""
        with contextlib.suppress(OSError):
            self._socket.sendto(data, to)

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


class TcpEndpoint:
    """A TCP connection to an autopilot, or to a bridge in front of its serial line."""

    def __init__(self, host: str, port: int, patience: float = 3.0) -> None:
        """Connect.

        Raises:
            PlantError: The connection is not accepted within ``patience`` [s].
        """
        try:
            self._socket = socket.create_connection((host, port), timeout=patience)
        except (OSError, OverflowError) as error:
            raise PlantError(f"tcp:{host}:{port} cannot be connected to: {error}") from error
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket.setblocking(False)

    def fileno(self) -> int:
        """Return the socket's descriptor."""
        return self._socket.fileno()

    def receive(self) -> tuple[bytes, Any] | None:
        """Return received data; the sender is ``"line"``."""
        try:
            data = self._socket.recv(LONGEST)
        except OSError:
            return None
        if not data:
            time.sleep(CLOSED_WAIT_S)
        return (data, "line") if data else None

    def send(self, data: bytes, to: Any) -> None:
        """Send data."""
        with contextlib.suppress(OSError):
            self._socket.send(data)

    def close(self) -> None:
        """Close the connection."""
        self._socket.close()


class SerialEndpoint:
    """A serial line: a telemetry port, or a flight controller on USB."""

    def __init__(self, device: str, baud: int) -> None:
        """Open the line.

        Raises:
            PlantError: The line does not exist, or pyserial is not installed.
        """
        serial = import_extra("serial", "mavlink", package="pyserial", kind="a serial line; the extra")
        try:
            self._line = serial.Serial(device, baud, timeout=0, write_timeout=0)
        except (serial.SerialException, ValueError) as error:
            raise PlantError(f"serial:{device}:{baud} cannot be opened: {error}") from error
        self._link_errors = (serial.SerialException, OSError)

    def fileno(self) -> int:
        """Return the line's descriptor."""
        return int(self._line.fileno())

    def receive(self) -> tuple[bytes, Any] | None:
        """Return received data; the sender is ``"line"``."""
        try:
            data = self._line.read(4096)
        except self._link_errors:
            return None
        return (bytes(data), "line") if data else None

    def send(self, data: bytes, to: Any) -> None:
        """Write to the line."""
        with contextlib.suppress(*self._link_errors):
            self._line.write(data)

    def close(self) -> None:
        """Close the line."""
        self._line.close()


def address_of(text: str, kinds: Sequence[str] = ("udp", "serial")) -> tuple[str, str, int]:
    """Return the parts of an address: its kind, the host or device, and the port or the baud rate.

    Args:
        text: ``udp:HOST:PORT`` to listen on, ``tcp:HOST:PORT`` to connect to, or ``serial:DEVICE:BAUD``.
        kinds: Kinds that the link supports.

    Raises:
        ConfigError: The text is not an address.
    """
    kind, _, rest = text.partition(":")
    place, _, number = rest.rpartition(":")
    most = 20_000_000 if kind == "serial" else 65_535
    if (
        kind not in kinds
        or not place
        or not (number.isascii() and number.isdecimal())
        or not 0 < int(number[-9:]) <= most
        or len(number) > 9
        or not (kind == "serial" or _may_be_host(place))
    ):
        raise ConfigError(f"address {text!r}: expected {', or '.join(FORMS[each] for each in kinds)}")
    return kind, place, int(number)


def _may_be_host(name: str) -> bool:
    """Return whether a name can be looked up; sockets raise UnicodeError for others, e.g. with an empty label."""
    try:
        return bool(name.encode("idna"))
    except UnicodeError:
        return False


def address_towards(host: str, port: int) -> str:
    """Return this machine's address on the route to a host, without sending data.

    A socket bound only to this address cannot be reached from other networks. For a vehicle on this machine, it is the
    loopback address; for a vehicle reached through a radio, it is the radio's address.

    Raises:
        PlantError: There is no route to the host.
    """
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect((host, port))
        except OSError as error:
            raise PlantError(f"udp:{host}:{port} cannot be reached: {error}") from error
        return str(probe.getsockname()[0])


def open_endpoint(address: str) -> Endpoint:
    """Open the endpoint for an address.

    Raises:
        ConfigError: The text is not an address.
        PlantError: The endpoint cannot be opened.
    """
    kind, place, number = address_of(address, tuple(FORMS))
    make: dict[str, Callable[[str, int], Endpoint]] = {
        "udp": UdpEndpoint,
        "tcp": TcpEndpoint,
        "serial": SerialEndpoint,
    }
    return make[kind](place, number)


def pump(endpoint: Endpoint, until: float, chores: Callable[[float], None], take: Callable[[bytes, Any], None]) -> None:
    """Read received data and do periodic work until an instant on the monotonic clock [s].

    Args:
        endpoint: Source of the data.
        until: End time; data that has already arrived is read even if this time has passed.
        chores: Periodic work; called with the current time.
        take: Called with the data from one read, and the sender.
    """
    while True:
        chores(time.monotonic())
        while (packet := endpoint.receive()) is not None:
            take(*packet)
        left = until - time.monotonic()
        if left <= 0.0:
            return
        select.select([endpoint], [], [], min(left, NAP_S))
