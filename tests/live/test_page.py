"""The page in a browser shows the vehicle, and its knobs change the flight."""

import os
import shutil
import time
from pathlib import Path
from unittest.mock import MagicMock
from urllib.parse import urlsplit

import jax.numpy as jnp
import numpy as np
import pytest

from live_processes import DT, HOME, PAGE_TOPICS, level
from retrim.errors import ConfigError
from retrim.live.operator.manual_disturbance import ManualDisturbance
from retrim.live.operator.page import PagePlan, _Page, free_port
from retrim.live.operator.page_access import page_url
from retrim.live.operator.scene import quaternion
from retrim.live.spec import PageSpec
from retrim.onboard.launch import launch
from retrim.onboard.messages import Sample, Setpoint, pack_note, unpack_note
from retrim.physics import so3
from retrim.transport.in_process import InProcessBus
from retrim.transport.shared_memory import SharedMemoryBus

BROWSER = shutil.which("chromium")
DRAWING = ("--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist",
           "--disable-background-networking", "--disable-component-update", "--no-first-run")  # fmt: skip


def test_occupied_port_is_skipped():
    import socket

    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        assert port < free_port("127.0.0.1", port) < port + 10
    with pytest.raises(ConfigError, match="no free port from 8080 on at 'no-such-host'"):
        free_port("no-such-host", 8080)


@pytest.mark.parametrize(
    "vector", [(0.1, -0.2, 0.3), (3.1, 0.0, 0.1), (0.0, 3.1, 0.2), (0.1, 0.1, 3.1), (0.0, 0.0, 0.0)]
)
def test_quaternion_equals_rotation_matrix(vector):
    w, *u = quaternion(np.asarray(so3.exp(jnp.array(vector))))
    x = np.array([0.3, -0.5, 0.8])
    turned_x = x + 2.0 * np.cross(u, np.cross(u, x) + w * x)
    np.testing.assert_allclose(turned_x, np.asarray(so3.exp(jnp.array(vector))) @ x, atol=1e-12)


@pytest.fixture
def flight(tmp_path):
    """Return a bus and the address of a page."""
    pytest.importorskip("viser")
    bus = SharedMemoryBus.create(dict.fromkeys(PAGE_TOPICS, 65536))
    port = free_port("127.0.0.1", 18080)
    paths = {"circle": HOME[None] + np.eye(3), "figure8": HOME[None] - np.eye(3)}
    spec = PageSpec("127.0.0.1", port, "hover", HOME[None].repeat(2, 0), ("full", "lora"), 0.06, 0.19, paths)
    process = launch("retrim.live.operator.page:show", PagePlan(bus.folder, spec, os.getpid()), tmp_path / "page.log")
    try:
        yield bus, page_url("127.0.0.1", port, spec.token)
    finally:
        process.terminate()
        process.wait()
        bus.remove()


def hover(bus, seconds, until=lambda: False):
    """Publish the state of a hovering vehicle for some seconds, or until a condition is true."""
    start, tick = time.monotonic(), 0
    while time.monotonic() < start + seconds and not until():
        sample = Sample(tick, tick * DT, time.monotonic(), 0.0, level(), level(), np.array([9.81, 0.0, 0.0, 0.0]))
        bus.publish("sample", sample.pack())
        fields = {"error": 0.02, "missed": 0, "target": list(HOME), "disturbance": [0.5, 0.0, 0.0]}
        bus.publish("status", pack_note("status", mode="policy", **fields))
        tick += 1
        time.sleep(DT)


def test_page_shows_present_source_of_commands(monkeypatch):
    pytest.importorskip("viser")
    bus, texts = InProcessBus(dict.fromkeys(PAGE_TOPICS, 65536)), []
    page = _Page(PageSpec("", 0, "hover", HOME[None].repeat(2, 0), (), 0.06, 0.19), bus, MagicMock())
    monkeypatch.setattr(page._panel, "show", texts.append)
    bus.publish("status", pack_note("status", mode="policy", error=0.0, missed=0))
    for tick, topic in enumerate(("setpoint", "fallback", "setpoint")):
        bus.publish(topic, Setpoint(tick, DT * tick, np.zeros(4), HOME).pack())
        page.refresh(text=True)
    assert [text.partition("**")[2].partition("**")[0] for text in texts] == ["policy", "watchdog", "policy"]


def test_page_listens_on_loopback_address_only(flight):
    bus, url = flight
    hover(bus, 60.0, lambda: bus.latest("ready.page") is not None)
    port = urlsplit(url).port
    assert unpack_note(bus.latest("ready.page").data, "ready")["port"] == port
    rows = [line.split() for file in ("tcp", "tcp6") for line in Path(f"/proc/net/{file}").read_text().splitlines()[1:]]
    listening = {row[1].split(":")[0] for row in rows if row[3] == "0A" and int(row[1].split(":")[1], 16) == port}
    assert listening == {"0100007F"}


@pytest.mark.skipif(BROWSER is None, reason="needs chromium: make test-page installs it")
def test_knob_in_browser_sends_message_on_bus(flight):
    api = pytest.importorskip("playwright.sync_api", reason="needs playwright: make test-page installs it")
    bus, url = flight
    hover(bus, 60.0, lambda: bus.latest("ready.page") is not None)
    with api.sync_playwright() as p:
        browser = p.chromium.launch(executable_path=BROWSER, args=list(DRAWING))
        page = browser.new_page(viewport={"width": 1280, "height": 900})
        page.goto(url)
        page.get_by_role("button", name="Land").wait_for(timeout=60_000)
        page.locator("canvas").first.wait_for()
        hover(bus, 3.0)
        page.get_by_text("error 2.0 cm").wait_for(timeout=30_000)
        page.get_by_text("+0.50 +0.00 +0.00").wait_for()
        push = page.get_by_text("push").locator("xpath=following::input[1]")
        push.fill("1.5")
        push.press("Enter")
        hover(bus, 20.0, lambda: bus.latest("knobs") is not None)
        assert ManualDisturbance.unpack(bus.latest("knobs").data).push == (1.5, 0.0, 0.0)
        page.get_by_text("+x").click()
        hover(bus, 20.0, lambda: ManualDisturbance.unpack(bus.latest("knobs").data).kicks == 1)
        assert ManualDisturbance.unpack(bus.latest("knobs").data).kick[0] > 0
        page.get_by_role("button", name="Calm").click()
        hover(bus, 20.0, lambda: ManualDisturbance.unpack(bus.latest("knobs").data).push[0] == 0.0)
        page.get_by_role("combobox", name="reference").click()
        page.get_by_role("option", name="figure8").click()
        hover(bus, 20.0, lambda: bus.latest("wish") is not None)
        assert unpack_note(bus.latest("wish").data, "wish") == {"reference": "figure8"}
        bus.publish("followed", pack_note("followed", name="figure8"))
        page.get_by_role("button", name="Land").click()
        hover(bus, 20.0, lambda: "land" in unpack_note(bus.latest("wish").data, "wish"))
        assert unpack_note(bus.latest("wish").data, "wish")["land"]
        screenshot = page.screenshot()
        browser.close()
    assert len(screenshot) > 10_000
