"""The page survives any input of a browser or another process, reports refusals, and always has its *Land* button."""

import asyncio
import contextlib
import io
import json
import time
from unittest.mock import MagicMock

import numpy as np
import pytest

from live_processes import HOME, PAGE_TOPICS, level
from retrim.live.operator.manual_disturbance import ManualDisturbance
from retrim.live.operator.page import _Page, free_port
from retrim.live.operator.page_input import take_values_only
from retrim.live.refused_notes import RefusedNotes
from retrim.live.spec import PageSpec
from retrim.onboard.messages import Sample, last_note, pack_note
from retrim.onboard.note_fields import FIELDS
from retrim.transport.in_process import InProcessBus
from retrim.transport.message import pack_arrays

PATHS = {"circle": HOME[None] + np.eye(3), "figure8": HOME[None] - np.eye(3)}
SPEC = PageSpec("127.0.0.1", 18380, "hover", HOME[None].repeat(2, 0), ("full", "lora"), 0.06, 0.19, PATHS)
ODD = (None, True, -1, 2**70, 1e308, float("nan"), "x", "<b>{x}</b>\x1b[2J", [], [1], [[None]], [float("inf")] * 3, {},
       {"policy": "x"}, {"a": {"b": []}})  # fmt: skip
NOISE = (
    b"", b"noise", pack_arrays({}, kind="wish", about={}), pack_arrays({}, kind="wish", about={"fields": "[" * 5000}),
    pack_arrays({}, kind="wish", about={"fields": "9" * 5000}), pack_arrays({}, kind="wish", about={"fields": "[]"}),
    pack_arrays({"a": np.zeros(3)}, kind="wish", about={"fields": "{}"}),
)  # fmt: skip
VALUES = (None, True, -1, 2**70, 1e300, float("nan"), float("inf"), "", "x", "land", b"x", [], [1], ["x", "y", "z"],
          [float("nan")] * 3, [1e9, 0.0, 0.0], [0.0] * 50, {}, {"a": 1}, [[], [], []])  # fmt: skip


@pytest.fixture
def server():
    """Return a viser server on a free port with one connected client."""
    viser = pytest.importorskip("viser")
    with contextlib.redirect_stdout(io.StringIO()):
        server = viser.ViserServer("127.0.0.1", free_port("127.0.0.1", 18380), verbose=False)
    server._connected_clients[0] = MagicMock()
    try:
        yield server
    finally:
        server._connected_clients.clear()
        server.stop()


@pytest.fixture
def bus():
    return InProcessBus(dict.fromkeys(PAGE_TOPICS, 65536))


def send(server, handle, **updates):
    """Send the message of a changed control, and wait until the page has processed it."""
    from viser._messages import GuiUpdateMessage

    connection = server._websock_server
    message = GuiUpdateMessage(handle._impl.uuid, updates)
    coroutine = connection._handle_incoming_message(0, message)
    asyncio.run_coroutine_threadsafe(coroutine, connection._background_event_loop).result(20.0)
    server._thread_executor.submit(time.sleep, 0.0).result(20.0)


def controls(server):
    return {handle._impl.props.label: handle for handle in server.gui._gui_input_handle_from_uuid.values()}


def wait_for(condition):
    end = time.monotonic() + 10.0
    while not condition() and time.monotonic() < end:
        time.sleep(0.01)
    return condition()


def test_page_survives_any_value_of_controls_and_lands(server, bus):
    page = _Page(SPEC, bus, server)
    take_values_only(server, page.refuse)
    result = controls(server)
    assert {"method", "pause", "reference", "Land", "rotor", "load [kg]", "kick"} <= result.keys()
    for label, handle in result.items():
        for value in VALUES:
            if label not in ("Land", "Calm"):
                send(server, handle, value=value)
    assert wait_for(lambda: last_note(bus, "refusals.page").get("count", 0) > 50)
    for label, handle in result.items():  # afterwards, every control shows the present value, and works
        if label in ("method", "reference", "rotor", "load [kg]", "push [m/s²]"):
            good = {"method": "lora", "reference": "figure8", "push [m/s²]": [1.0, 0.5, 0.0]}.get(label, 0.75)
            good = 0.1 if label == "load [kg]" else good
            send(server, handle, value=good)
    assert wait_for(lambda: last_note(bus, "wish").get("reference") == "figure8")
    assert wait_for(lambda: last_note(bus, "wish").get("method") == "lora")
    assert wait_for(lambda: ManualDisturbance.unpack(bus.latest("knobs").data).load == 0.1)
    assert wait_for(lambda: ManualDisturbance.unpack(bus.latest("knobs").data).push == (1.0, 0.5, 0.0))
    send(server, result["Land"], value=True)
    assert wait_for(lambda: last_note(bus, "wish").get("land") is True)
    _Page(SPEC, bus, MagicMock())  # a restarted page begins with this request


@pytest.mark.parametrize("updates", [{"visible": False}, {"removed": True}, {"disabled": True, "value": True}, {}])
def test_browser_cannot_remove_land_button(server, bus, updates):
    page = _Page(SPEC, bus, server)
    take_values_only(server, page.refuse)
    land = controls(server)["Land"]
    send(server, land, **updates)
    assert land.visible
    assert not land.disabled
    assert not land._impl.removed
    assert last_note(bus, "refusals.page")["count"] == 1
    assert "land" not in last_note(bus, "wish")


@pytest.mark.parametrize("topic", [topic for topic in PAGE_TOPICS if topic not in ("sample", "setpoint", "fallback")])
def test_page_and_restarted_page_survive_any_note(bus, topic):
    pytest.importorskip("viser")
    kind = topic.partition(".")[0]
    name = "ready" if kind == "ready" else topic
    hostile = [*NOISE, pack_note("other", x=1)]
    for field in FIELDS[kind]:
        hostile += [pack_note(name, **{field: value}) for value in ODD]
        hostile += [pack_note(name, **dict.fromkeys(FIELDS[kind], 1) | {field: ODD[-1]})]
    sample = Sample(1, 0.0, 0.0, 0.0, level(), level(), np.array([9.81, 0.0, 0.0, 0.0]))
    good = {name: [0.0, 0.0, 1.0] for name in ("disturbance", "estimate", "target")}
    before, watch = _Page(SPEC, bus, MagicMock()), RefusedNotes(bus, PAGE_TOPICS)
    bus.publish("status", pack_note("status", mode="policy", error=0.0, missed=0, **good))
    for tick, data in enumerate(hostile):
        bus.publish(topic, data)
        bus.publish("sample", Sample(tick, *list(vars(sample).values())[1:]).pack())
        restart = kind in ("wish", "knobs", "refusals.page") or tick % 10 == 0  # a new page reads these notes
        for page in (before, *([_Page(SPEC, bus, MagicMock())] if restart else [])):
            page.refresh(text=True)
            page._panel.show("x")
        watch.look()
        assert page._wish(land=True)["land"]
        assert last_note(bus, "wish") == page._wishes | {"land": True}
    assert watch.count >= len(NOISE)


def test_invalid_attitude_is_not_shown(bus):
    pytest.importorskip("viser")
    page, display = _Page(SPEC, bus, MagicMock()), []
    page._scene.move = lambda *argument: display.append(argument)
    for tick, R in enumerate((np.zeros(9), np.eye(3).ravel() * 1e200, -np.ones(9), np.eye(3).ravel())):
        x = level()
        x[:3], x[3:12] = 1e308, R
        bus.publish("sample", Sample(tick, 0.0, 0.0, 0.0, x, x, np.array([9.81, 0.0, 0.0, 0.0])).pack())
        page.refresh(text=True)
    assert len(display) == 1


def test_text_of_process_is_not_interpreted_as_markup(bus, monkeypatch):
    pytest.importorskip("viser")
    page, texts = _Page(SPEC, bus, MagicMock()), []
    monkeypatch.setattr(page._panel, "show", texts.append)
    bus.publish("status", pack_note("status", mode="<script>", reason="{alert(1)} [a](http://b) `c`\x1b", error=0.0))
    page.refresh(text=True)
    (text,) = texts
    assert not set("{}[]`\x1b") & set(text.partition("<br>")[0])
    assert "<script" not in text


def test_refused_notes_are_counted_and_occasionally_reported():
    bus = InProcessBus({"learner.policy": 4096, "sample": 4096, "refusals.page": 4096})
    watch, texts = RefusedNotes(bus, ("learner.policy", "sample", "refusals.page")), []
    for i in range(12):
        bus.publish("learner.policy", pack_note("learner.policy", took="x" * (i + 1)))
        bus.publish("sample", b"no note")
        texts += watch.look()
        assert watch.look() == []
    assert texts == [
        "note learner.policy: learner.policy: took = 'x' must be a number; 1 so far",
        "note learner.policy: learner.policy: took = 'xxxxxxxxxx' must be a number; 10 so far",
    ]
    bus.publish("learner.policy", pack_note("learner.policy", took=1.0))
    bus.publish("refusals.page", pack_note("refusals.page", count=3, last="knobs: turned too far"))
    assert watch.look() == ["page: knobs: turned too far; 3 so far"]
    bus.publish("refusals.page", pack_note("refusals.page", count=2, last="of a page that was started again"))
    assert watch.look() == []
    assert watch.count == 17
    assert json.dumps(watch.count)
