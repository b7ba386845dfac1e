"""Addresses of vehicles, and the two kinds of endpoints."""

import os
import pty
import select
import socket

import numpy as np
import pytest

from retrim import ConfigError, PlantError
from retrim.plants.bridges.crazyflie import CrazyfliePlant
from retrim.plants.bridges.endpoint import Endpoint, address_of, address_towards, open_endpoint


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("udp:127.0.0.1:14540", ("udp", "127.0.0.1", 14540)),
        ("udp:0.0.0.0:1", ("udp", "0.0.0.0", 1)),
        ("serial:/dev/ttyACM0:921600", ("serial", "/dev/ttyACM0", 921600)),
        ("serial:/dev/serial/by-id/usb-1:0:57600", ("serial", "/dev/serial/by-id/usb-1:0", 57600)),
    ],
)
def test_addresses(text, parts):
    assert address_of(text) == parts


@pytest.mark.parametrize(
    "text",
    [
        "", "udp", "udp:", "udp:14540", "udp::14540", "udp:127.0.0.1:", "udp:127.0.0.1:0", "udp:127.0.0.1:65536",
        "udp:127.0.0.1:-1", "udp:127.0.0.1:1e3", "tcp:127.0.0.1:14540", "serial:/dev/ttyACM0", "serial::9600",
        "udp:127.0.0.1:" + "9" * 5000, "udp:127.0.0.1:١٤٥", "127.0.0.1:14540",
        "udp:..:1", f"udp:{'x' * 64}:1",
    ],
)  # fmt: skip
def test_invalid_address_is_refused(text):
    with pytest.raises(ConfigError, match="expected udp:HOST:PORT"):
        address_of(text)


def test_port_is_opened_and_released():
    first = open_endpoint("udp:127.0.0.1:24540")
    assert isinstance(first, Endpoint)
    with pytest.raises(PlantError, match="24540 cannot be opened"):
        open_endpoint("udp:127.0.0.1:24540")
    first.close()
    open_endpoint("udp:127.0.0.1:24540").close()


@pytest.mark.parametrize("address", ["udp:no.such.host.invalid:14540", "udp:203.0.113.9:14540"])
def test_remote_listening_address_is_refused(address):
    with pytest.raises(PlantError, match="cannot be opened"):
        open_endpoint(address)


def test_endpoint_listens_only_on_route_to_vehicle():
    assert address_towards("127.0.0.1", 19850) == "127.0.0.1"
    beyond = address_towards_or_none("192.0.2.1")
    assert beyond != "0.0.0.0"
    with socket.create_server(("127.0.0.1", 0)) as server:
        plant = CrazyfliePlant(f"udp:127.0.0.1:{server.getsockname()[1]}", 0.02, np.zeros(4), np.ones(4))
        with pytest.raises(PlantError, match="flight was aborted"):
            plant.connect(lambda: False)
        assert plant.link._endpoint._socket.getsockname()[0] == "127.0.0.1"
        plant.land()


def address_towards_or_none(host):
    """Return the address, or None on a machine without a network."""
    try:
        return address_towards(host, 19850)
    except PlantError:
        return None


def test_serial_line_is_bidirectional():
    ours, theirs = pty.openpty()
    line = open_endpoint(f"serial:{os.ttyname(theirs)}:57600")
    try:
        assert isinstance(line, Endpoint)
        assert line.receive() is None
        os.write(ours, b"hello")
        assert select.select([line], [], [], 5.0)[0]
        assert line.receive() == (b"hello", "line")
        line.send(b"back", "line")
        assert select.select([ours], [], [], 5.0)[0]
        assert os.read(ours, 10) == b"back"
    finally:
        line.close()
        os.close(ours)
        os.close(theirs)


def test_missing_serial_line_is_refused():
    with pytest.raises(PlantError, match="serial:/dev/nothing:57600 cannot be opened"):
        open_endpoint("serial:/dev/nothing:57600")
