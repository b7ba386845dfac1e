"""Restrict access to a flight's page: only users with the printed address may open the page, and only at that address.

Every website that is open in a browser can send requests to this machine. The server therefore answers a request only
if its path begins with a random token, its ``Host`` is the address that the request has reached, and its ``Origin`` is
the page itself. An attacker's name that resolves to this machine (DNS rebinding) is a different ``Host``.
"""

import contextlib
import hmac
import socket
from collections.abc import Iterator, Mapping
from dataclasses import replace
from http import HTTPStatus
from ipaddress import IPv6Address, ip_address
from typing import Any

from ...errors import PlantError

ALL_ADDRESSES = ("", "0.0.0.0", "::")
"""Addresses that stand for all addresses of this machine."""
HEADERS = {
    "Referrer-Policy": "no-referrer",  # otherwise a link to another site would send the token
    "Cache-Control": "no-store",
    "X-Frame-Options": "DENY",
    "Content-Security-Policy": "frame-ancestors 'none'",
    "Cross-Origin-Resource-Policy": "same-origin",
}
"""Headers of every response."""


def page_url(host: str, port: int, token: str) -> str:
    """Return the address, including the token, of a page that listens on ``host``."""
    return f"http://{_bracket(_outward() if host in ALL_ADDRESSES else host)}:{port}/{token}"


def refusal(
    path: str, headers: Mapping[str, tuple[str, ...]], *, token: str, host: str, local: tuple[Any, ...]
) -> HTTPStatus | None:
    """Return the HTTP status with which to refuse a request; None if the request is allowed.

    Args:
        path: Unmodified path of the request, with its query.
        headers: All values of each header of the request, by name in lower case.
        token: First part of every path of the page.
        host: Address that the page listens on.
        local: Address and port that the request has reached, in the format of a socket.
    """
    hosts, origins = headers.get("host", ()), headers.get("origin", ())
    if len(hosts) != 1 or hosts[0].lower() not in _authorities(host, local):
        return HTTPStatus.FORBIDDEN
    path_token = path.partition("?")[0].split("/")[1:2] if path.startswith("/") else []
    if not hmac.compare_digest("".join(path_token).encode("utf-8", "replace"), token.encode()):
        return HTTPStatus.NOT_FOUND
    upgrade = bool(headers.get("upgrade", ()))  # browsers always send the origin of a WebSocket
    if (upgrade or origins) and origins != (f"http://{hosts[0].lower()}",):
        return HTTPStatus.FORBIDDEN
    return None


@contextlib.contextmanager
def only_for(token: str, host: str) -> Iterator[None]:
    """Restrict each ``websockets`` server that starts in this context to requests with the token.

    viser serves files and WebSockets with one such server and provides no hook for access control.

    Args:
        token: First part of every path of the page.
        host: Address that the page listens on.

    Raises:
        PlantError: No server has started in the context, so the page may be unprotected.
    """
    import websockets.asyncio.server as servers

    serve, started_servers = servers.serve, list[bool]()

    def serve_guarded(*args: Any, process_request: Any = None, **options: Any) -> Any:
        started_servers.append(True)

        def answer(connection: Any, request: Any) -> Any:
            headers = {name.lower(): tuple(request.headers.get_all(name)) for name in request.headers}
            reason = refusal(request.path, headers, token=token, host=host, local=connection.local_address)
            if reason is not None:
                response = connection.respond(reason, f"{reason.phrase}\n")
            elif process_request is None:
                response = None
            else:
                inner = request.path.partition(token)[2]
                response = process_request(connection, replace(request, path=inner or "/"))
            if response is not None:
                for name, value in HEADERS.items():
                    response.headers[name] = value
            return response

        return serve(*args, process_request=answer, **options)

    servers.serve = serve_guarded  # type: ignore[assignment, misc]
    try:
        yield
    finally:
        servers.serve = serve  # type: ignore[misc]
    if not started_servers:
        raise PlantError("page: this version of viser cannot be protected by a token; pip install --upgrade viser")


def _authorities(host: str, local: tuple[Any, ...]) -> set[str]:
    """Return the valid ``Host`` values, with the port, for an address that a browser has reached."""
    address, port = ip_address(str(local[0]).partition("%")[0]), int(local[1])
    if isinstance(address, IPv6Address) and address.ipv4_mapped is not None:
        address = address.ipv4_mapped
    names = {_bracket(str(address))} | ({"localhost"} if address.is_loopback else set())
    if host not in ALL_ADDRESSES:
        names.add(_bracket(host.lower()))
    return {f"{name}:{port}" for name in names} | (names if port == 80 else set())


def _bracket(host: str) -> str:
    return f"[{host}]" if ":" in host else host


def _outward() -> str:
    """Return the address at which other machines reach this one, without sending a packet."""
    with contextlib.suppress(OSError), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.connect(("192.0.2.1", 9))
        return str(probe.getsockname()[0])
    return "127.0.0.1"
