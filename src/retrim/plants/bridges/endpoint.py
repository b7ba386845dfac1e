"""Where bytes of an autopilot come from and go to: a UDP port, or a serial line."""

import contextlib
import select
import socket
import time
from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

from ...errors import ConfigError, PlantError
from ..extras import import_extra

LONGEST = 65_535
NAP_S = 0.02  # [s]: at least as often, chores are done


@runtime_checkable
class Endpoint(Protocol):
    """One end of a link. Nothing of it blocks."""

    def fileno(self) -> int:
        """Return the descriptor that becomes readable when something has come."""
        ...

    def receive(self) -> tuple[bytes, Any] | None:
        """Return what has come and who sent it; None if nothing has."""
        ...

    def send(self, data: bytes, to: Any) -> None:
        """Send to who was heard; what cannot be sent is lost, as on any link."""
        ...

    def close(self) -> None:
        """Give the port back. Idempotent."""
        ...


class UdpEndpoint:
    """A UDP port that an autopilot sends to."""

    def __init__(self, host: str, port: int) -> None:
        """Listen.

        Raises:
            PlantError: The port cannot be had.
        """
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.bind((host, port))
        except (OSError, OverflowError) as error:
            self._socket.close()
            raise PlantError(f"udp:{host}:{port} cannot be listened on: {error}") from error
        self._socket.setblocking(False)

    def fileno(self) -> int:
        """Return the socket's descriptor."""
        return self._socket.fileno()

    def receive(self) -> tuple[bytes, Any] | None:
        """Return a datagram and its sender."""
        try:
            return self._socket.recvfrom(LONGEST)
        except OSError:  # nothing there, or somebody who was sent to is not there any more
            return None

    def send(self, data: bytes, to: Any) -> None:
        """Send a datagram."""
        with contextlib.suppress(OSError):
            self._socket.sendto(data, to)

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


class SerialEndpoint:
    """A serial line: a telemetry port, or a flight controller on USB."""

    def __init__(self, device: str, baud: int) -> None:
        """Open the line.

        Raises:
            PlantError: There is no such line, or pyserial is not installed.
        """
        serial = import_extra("serial", "mavlink", package="pyserial")
        try:
            self._line = serial.Serial(device, baud, timeout=0, write_timeout=0)
        except (serial.SerialException, ValueError) as error:
            raise PlantError(f"serial:{device}:{baud} cannot be opened: {error}") from error
        self._lost = (serial.SerialException, OSError)

    def fileno(self) -> int:
        """Return the line's descriptor."""
        return int(self._line.fileno())

    def receive(self) -> tuple[bytes, Any] | None:
        """Return what has come; the sender is the line."""
        try:
            data = self._line.read(4096)
        except self._lost:
            return None
        return (bytes(data), "line") if data else None

    def send(self, data: bytes, to: Any) -> None:
        """Write to the line."""
        with contextlib.suppress(*self._lost):
            self._line.write(data)

    def close(self) -> None:
        """Close the line."""
        self._line.close()


def address_of(text: str) -> tuple[str, str, int]:
    """Return the parts of an address: its kind, where, and the port or the baud rate.

    Args:
        text: ``udp:HOST:PORT`` to listen there, or ``serial:DEVICE:BAUD``.

    Raises:
        ConfigError: It is no address.
    """
    kind, _, rest = text.partition(":")
    place, _, number = rest.rpartition(":")
    most = 65_535 if kind == "udp" else 20_000_000
    if (
        kind not in ("udp", "serial")
        or not place
        or not (number.isascii() and number.isdecimal())
        or not 0 < int(number[-9:]) <= most
        or len(number) > 9
    ):
        raise ConfigError(
            f"address {text!r}: expected udp:HOST:PORT, as udp:127.0.0.1:14540, or serial:DEVICE:BAUD, as "
            f"serial:/dev/ttyACM0:921600"
        )
    return kind, place, int(number)


def address_towards(host: str, port: int) -> str:
    """Return the address of this machine from which another one is reached; nothing is sent.

    Whoever listens on that address only is not reached by other networks: the loopback address for a vehicle on this
    machine, that of the radio for one on a radio.

    Raises:
        PlantError: There is no way there.
    """
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect((host, port))
        except OSError as error:
            raise PlantError(f"udp:{host}:{port} cannot be reached: {error}") from error
        return str(probe.getsockname()[0])


def open_endpoint(address: str) -> Endpoint:
    """Open what an address names.

    Raises:
        ConfigError: It is no address.
        PlantError: It cannot be opened.
    """
    kind, place, number = address_of(address)
    return UdpEndpoint(place, number) if kind == "udp" else SerialEndpoint(place, number)


def pump(endpoint: Endpoint, until: float, chores: Callable[[float], None], take: Callable[[bytes, Any], None]) -> None:
    """Read what comes, and do what has to be done now and then, until an instant of the monotonic clock [s].

    Args:
        endpoint: Where bytes come from.
        until: When it ends; what has come is read all the same.
        chores: Called with the time.
        take: Called with what has come in one go, and who sent it.
    """
    while True:
        chores(time.monotonic())
        while (come := endpoint.receive()) is not None:
            take(*come)
        left = until - time.monotonic()
        if left <= 0.0:
            return
        select.select([endpoint], [], [], min(left, NAP_S))
