"""A page accepts only requests with its printed address."""

import os
import socket
import webbrowser
from http import HTTPStatus
from urllib.parse import urlsplit

import pytest

from live_processes import HOME, PAGE_TOPICS
from retrim.errors import PlantError
from retrim.live.operator.page import PagePlan, free_port
from retrim.live.operator.page_access import only_for, page_url, refusal
from retrim.live.operator.page_opening import open_page
from retrim.live.spec import PageSpec
from retrim.onboard.launch import launch
from retrim.transport.shared_memory import SharedMemoryBus

WITHIN = 60.0  # [s]


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    """Return the port, the token and the protocol of a page that listens."""
    viser = pytest.importorskip("viser")
    bus = SharedMemoryBus.create(dict.fromkeys(PAGE_TOPICS, 65536))
    spec = PageSpec("127.0.0.1", free_port("127.0.0.1", 18280), "hover", HOME[None].repeat(2, 0), (), 0.06, 0.19)
    log = tmp_path_factory.mktemp("page") / "page.log"
    process = launch("retrim.live.operator.page:show", PagePlan(bus.folder, spec, os.getpid()), log)
    try:
        assert _wait_for(lambda: bus.latest("ready.page") is not None), log.read_text()
        yield spec.port, spec.token, f"viser-v{viser.__version__}"
    finally:
        process.terminate()
        process.wait()
        bus.remove()


def _wait_for(condition):
    import time

    end = time.monotonic() + WITHIN
    while not condition() and time.monotonic() < end:
        time.sleep(0.05)
    return condition()


def status(port, path, *headers):
    """Return the status of the answer to a request, or 0 without an answer."""
    lines = (f"GET {path} HTTP/1.1", *headers, "", "")
    with socket.create_connection(("127.0.0.1", port), 20.0) as connection:
        connection.sendall("\r\n".join(lines).encode("latin-1"))
        answer = connection.recv(65536)
    return int(answer.split()[1]) if answer else 0


def handshake(page, path="/{token}", host="127.0.0.1:{port}", origin="http://127.0.0.1:{port}", more=()):
    """Return the status of a WebSocket handshake; a null value omits a header."""
    port, token, protocol = page
    fill = {"port": port, "next": port + 1, "token": token, "short": token[:-1], "bare": token.swapcase()}
    lines = [f"{name}: {value.format(**fill)}" for name, value in (("Host", host), ("Origin", origin)) if value]
    lines += ["Connection: Upgrade", "Upgrade: websocket", "Sec-WebSocket-Version: 13",
              "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==", f"Sec-WebSocket-Protocol: {protocol}"]  # fmt: skip
    return status(port, path.format(**fill), *lines, *(line.format(**fill) for line in more))


HOSTILE = {
    "no token": {"path": "/"},
    "an empty path": {"path": "//"},
    "another token": {"path": "/" + "A" * 32},
    "a shorter token": {"path": "/{short}"},
    "a longer token": {"path": "/{token}A"},
    "a token in other letters": {"path": "/{bare}"},
    "a token in the query": {"path": "/?token={token}"},
    "a token in the second place": {"path": "/page/{token}"},
    "a token after an empty part": {"path": "//{token}"},
    "a token behind dots": {"path": "/./{token}"},
    "a token that is encoded": {"path": "/%2F{token}"},
    "a token in a header": {"path": "/", "more": ("Authorization: Bearer {token}",)},
    "a token in a cookie": {"path": "/", "more": ("Cookie: token={token}",)},
    "a whole address as path": {"path": "http://127.0.0.1:{port}/{token}"},
    "no origin": {"origin": None},
    "a null origin": {"origin": "null"},
    "a foreign origin": {"origin": "http://evil.example"},
    "a foreign origin at this port": {"origin": "http://evil.example:{port}"},
    "an origin that begins alike": {"origin": "http://127.0.0.1:{port}.evil.example"},
    "an origin that ends alike": {"origin": "http://evil.example/http://127.0.0.1:{port}"},
    "an origin with a user": {"origin": "http://127.0.0.1:{port}@evil.example"},
    "an origin with another scheme": {"origin": "https://127.0.0.1:{port}"},
    "a file": {"origin": "file://"},
    "another server of this machine": {"origin": "http://127.0.0.1:{next}"},
    "an origin without a port": {"origin": "http://127.0.0.1"},
    "an origin of another name": {"origin": "http://localhost:{port}"},
    "two origins": {"more": ("Origin: http://evil.example",)},
    "no host": {"host": None},
    "a name that a stranger points here": {"host": "evil.example:{port}", "origin": "http://evil.example:{port}"},
    "a subdomain": {"host": "localhost.evil.example:{port}", "origin": "http://localhost.evil.example:{port}"},
    "a name of numbers": {"host": "127.0.0.1.nip.io:{port}", "origin": "http://127.0.0.1.nip.io:{port}"},
    "every address": {"host": "0.0.0.0:{port}", "origin": "http://0.0.0.0:{port}"},
    "an address of IPv6": {"host": "[::1]:{port}", "origin": "http://[::1]:{port}"},
    "a mapped address": {"host": "[::ffff:127.0.0.1]:{port}", "origin": "http://[::ffff:127.0.0.1]:{port}"},
    "a short address": {"host": "127.1:{port}", "origin": "http://127.1:{port}"},
    "an address as one number": {"host": "2130706433:{port}", "origin": "http://2130706433:{port}"},
    "another loopback address": {"host": "127.0.0.2:{port}", "origin": "http://127.0.0.2:{port}"},
    "a final dot": {"host": "localhost.:{port}", "origin": "http://localhost.:{port}"},
    "another port": {"host": "127.0.0.1:{next}", "origin": "http://127.0.0.1:{next}"},
    "no port": {"host": "127.0.0.1", "origin": "http://127.0.0.1"},
    "a host with a user": {"host": "evil@127.0.0.1:{port}", "origin": "http://127.0.0.1:{port}"},
    "two hosts": {"more": ("Host: evil.example",)},
    "a host in another header": {"host": "evil.example", "more": ("X-Forwarded-Host: 127.0.0.1:{port}",)},
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_handshake_is_refused(page, name):
    assert handshake(page, **HOSTILE[name]) in (400, 403, 404)


@pytest.mark.parametrize("host", ["127.0.0.1:{port}", "localhost:{port}", "LOCALHOST:{port}"])
def test_printed_address_opens_page_and_websocket(page, host):
    port, token, _ = page
    assert handshake(page, host=host, origin=f"http://{host.lower()}") == 101
    for path in (f"/{token}", f"/{token}/", f"/{token}/index.html", f"/{token}?x=1"):
        assert status(port, path, "Host: " + host.format(port=port)) == 200


def test_file_is_refused_like_handshake(page):
    port, token, _ = page
    assert status(port, "/", f"Host: 127.0.0.1:{port}") == 404
    assert status(port, "/index.html", f"Host: 127.0.0.1:{port}") == 404
    assert status(port, f"/{token}", f"Host: evil.example:{port}") == 403
    assert status(port, f"/{token}", f"Host: 127.0.0.1:{port}", "Origin: http://evil.example") == 403
    assert status(port, f"/{token}/../../../../etc/passwd", f"Host: 127.0.0.1:{port}") == 404


@pytest.mark.parametrize(
    ("host", "local", "names"),
    [
        ("0.0.0.0", ("192.168.1.5", 8080), {"192.168.1.5:8080"}),
        ("", ("127.0.0.1", 8080), {"127.0.0.1:8080", "localhost:8080"}),
        ("quad.local", ("192.168.1.5", 8080), {"192.168.1.5:8080", "quad.local:8080"}),
        ("::1", ("::1", 8080, 0, 0), {"[::1]:8080", "localhost:8080"}),
        ("::", ("::ffff:10.0.0.2", 80, 0, 0), {"10.0.0.2:80", "10.0.0.2"}),
    ],
)
def test_page_accepts_only_names_of_reached_address(host, local, names):
    hosts = {*names, "192.168.1.5:8080", "localhost:8080", "quad.local:8080", "0.0.0.0:8080", "evil.example:8080"}
    accepted = {
        name for name in hosts
        if refusal("/T", {"host": (name,)}, token="T", host=host, local=local) is None
    }  # fmt: skip
    assert accepted == names
    wrong = refusal("/t", {"host": (min(names),)}, token="T", host=host, local=local)
    assert wrong == HTTPStatus.NOT_FOUND


def test_page_address_has_own_token_and_reachable_host():
    specs = [PageSpec("0.0.0.0", 80, "", HOME[None], (), 0.1, 1.0) for _ in range(2)]
    assert specs[0].token != specs[1].token
    assert specs[0].token not in repr(specs[0])
    assert urlsplit(page_url("0.0.0.0", 8080, "T")).hostname not in ("0.0.0.0", "", None)
    assert page_url("::1", 8080, "T") == "http://[::1]:8080/T"


def test_page_without_protection_is_refused():
    pytest.importorskip("viser")
    with pytest.raises(PlantError, match="cannot be protected"), only_for("T", "127.0.0.1"):
        pass


def test_browser_reads_address_from_private_file(tmp_path, monkeypatch):
    urls = []
    monkeypatch.setattr(webbrowser, "open", urls.append)
    monkeypatch.setenv("DISPLAY", ":0")
    open_page("http://127.0.0.1:8080/SECRET", tmp_path)
    (file,) = tmp_path.iterdir()
    assert urls == [file.as_uri()]
    assert "SECRET" not in urls[0]
    assert "url=http://127.0.0.1:8080/SECRET" in file.read_text()
    assert file.stat().st_mode & 0o777 == 0o600
