"""The CRTP link of a Crazyflie: accepted messages, accepted senders, and sent packets."""

import struct
import time

import numpy as np
import pytest

from fake_wire import Wire
from retrim import PlantError
from retrim.plants.bridges import crtp
from retrim.plants.bridges.crazyflie_link import STATES, STATUSES, CrazyflieLink
from retrim.plants.bridges.crtp import Packet

HERE, ELSEWHERE = ("127.0.0.1", 19850), ("127.0.0.1", 19851)
UPRIGHT = np.eye(3)


@pytest.fixture
def wire():
    setup = Wire()
    yield setup
    setup.close()


@pytest.fixture
def link(wire):
    return CrazyflieLink(wire, HERE)


def send(wire):
    return [crtp.unpack(data) for data, _ in wire.packets]


def says(wire, link, block, ms, values, sender=HERE):
    packet = Packet(crtp.LOG, crtp.DATA, bytes([block]) + (ms % (1 << 24)).to_bytes(3, "little") + values)
    wire.inbox.append((packet.pack(), sender))
    link.pump(0.0)


def state(p=(0.0, 0.0, 1.0), v=(0.0, 0.0, 0.0), omega=(0.0, 0.0, 0.0)):
    return crtp.state_values(np.array(p), UPRIGHT, np.array(v), np.array(omega))


def test_state_is_converted_to_retrim_frames(wire, link):
    says(wire, link, STATES, 1000, state((1.0, -2.0, 0.5), (0.1, 0.2, 0.3), (0.4, 0.5, 0.6)))
    x = link.reading
    np.testing.assert_allclose(x.p, [1.0, -2.0, 0.5], atol=1e-3)
    np.testing.assert_allclose(x.v, [0.1, 0.2, 0.3], atol=1e-3)
    np.testing.assert_allclose(x.omega, [0.4, 0.5, 0.6], atol=1e-3)
    assert 0.0 <= time.monotonic() - x.stamp < 0.5


def test_late_state_has_its_stated_age(wire, link):
    says(wire, link, STATES, 1000, state())
    time.sleep(0.05)
    says(wire, link, STATES, 1010, state())
    assert time.monotonic() - link.reading.stamp == pytest.approx(0.04, abs=0.02)


def test_time_may_wrap_after_four_hours(wire, link):
    says(wire, link, STATES, (1 << 24) - 5, state())
    says(wire, link, STATES, (1 << 24) + 5, state((0.1, 0.0, 1.0)))
    assert link.reading.p[0] == pytest.approx(0.1)
    assert link.ignored == 0


def test_overtaken_state_is_ignored(wire, link):
    says(wire, link, STATES, 1010, state((0.1, 0.0, 1.0)))
    says(wire, link, STATES, 1000, state((0.0, 0.0, 1.0)))
    assert link.reading.p[0] == pytest.approx(0.1)


def test_time_jump_is_accepted_only_after_silence(wire, link):
    says(wire, link, STATES, 1000, state())
    says(wire, link, STATES, 1010, state((5.0, 0.0, 1.0)))
    assert (link.reading.p[0], link.ignored) == (0.0, 1)
    time.sleep(0.6)
    says(wire, link, STATES, 1610, state((5.0, 0.0, 1.0)))
    assert link.reading.p[0] == pytest.approx(5.0)


def test_status_is_read(wire, link):
    says(wire, link, STATUSES, 1000, crtp._STATUS.pack(30_000.0, crtp.ARMED | crtp.CAN_FLY, 3.9))
    assert link.status.info & crtp.ARMED
    assert list(link.thrusts) == [30_000.0]


def test_2000_damaged_packets_are_refused(wire, link):
    """The packets are random, truncated, from other senders, or logs of the right length with random content."""
    rng = np.random.default_rng(0)
    says(wire, link, STATES, 5_000_000, state())
    says(wire, link, STATUSES, 5_000_000, crtp._STATUS.pack(1.0, 0, 3.9))
    good = Packet(crtp.LOG, crtp.DATA, bytes([STATES]) + (5_000_010).to_bytes(3, "little") + state((9.0, 9.0, 9.0)))
    before, reply = link.reading, link.last_message
    for k in range(2000):
        kind = k % 4
        if kind == 0:
            data = rng.bytes(int(rng.integers(0, 40)))
            data = data if len(data) == 0 or (data[0] >> 4, data[0] & 3) != (crtp.CONSOLE, 0) else b""
        elif kind == 1:
            data = good.pack()[: int(rng.integers(0, len(good.pack())))]
        elif kind == 2:
            data = good.pack()
        else:
            data = Packet(crtp.LOG, crtp.DATA, bytes([1 + k // 4 % 2]) + rng.bytes(3 + 22)).pack()
        wire.inbox.append((data, ELSEWHERE if kind == 2 else HERE))
        link.pump(0.0)
    assert link.reading is before
    assert link.status.thrust == 1.0
    assert link.last_message >= reply
    assert link.ignored > 1400  # the others were for ports without a receiver
    says(wire, link, STATES, 5_000_020, state((0.1, 0.0, 1.0)))
    assert link.reading.p[0] == pytest.approx(0.1)


def firmware_responder(names, *, version=12, refuses=0):
    """Return a function that answers the requests of a start like the firmware."""

    def answer(data):
        packet = exchange(crtp.unpack(data))
        return None if packet is None else packet.pack()

    def exchange(packet):
        port, channel, body = packet
        if (port, channel) == (crtp.PLATFORM, 1):
            return packet._replace(body=bytes([0, version]))
        if (port, channel) == (crtp.LOG, crtp.TOC) and body[0] == crtp.INFO:
            return packet._replace(body=struct.pack("<BHIBB", crtp.INFO, len(names), 1, 16, 128))
        if (port, channel) == (crtp.LOG, crtp.TOC):
            name = names[int.from_bytes(body[1:3], "little")].encode().replace(b".", b"\0") + b"\0"
            return packet._replace(body=body[:3] + b"\5" + name)
        if (port, channel) == (crtp.LOG, crtp.CONTROL):
            return packet._replace(body=body[:2].ljust(2, b"\0") + bytes([refuses if body[0] == crtp.START else 0]))
        return None

    return answer


def test_logs_are_requested_by_number(wire, link):
    names = ["other.one", *reversed(crtp.STATE_LOG), "other.two", *crtp.STATUS_LOG, "other.three"]
    wire.answer = firmware_responder(names)
    link.start_logs(1.0, lambda: True)
    setup = [packet.body for packet in send(wire) if (packet.port, packet.channel) == (crtp.LOG, crtp.CONTROL)]
    listed_rows = [
        n for body in setup if body[0] in (crtp.CREATE, crtp.APPEND) for _, n in struct.iter_unpack("<BH", body[2:])
    ]
    assert [names[n] for n in listed_rows] == [*crtp.STATE_LOG, *crtp.STATUS_LOG]
    assert [body for body in setup if body[0] == crtp.START] == [bytes([3, 1, 1]), bytes([3, 2, 5])]
    assert link.version == 12
    calls = [packet.body for packet in send(wire) if packet[:2] == (crtp.LOG, crtp.TOC) and packet.body[0] == crtp.ITEM]
    assert len(calls) == len(names) - 1  # the table of contents is read only as far as necessary


@pytest.mark.parametrize(
    ("answer", "why"),
    [
        (lambda data: None, "does not answer on port 13 in 0.3 s"),
        (
            firmware_responder([*crtp.STATE_LOG, "pm.vbat"]),
            "does not log stabilizer.thrust, supervisor.info; its firmware is too old",
        ),
        (firmware_responder([*crtp.STATE_LOG, *crtp.STATUS_LOG], refuses=12), "refuses a block of its log: error 12"),
    ],
)
def test_missing_log_variable_is_refused(wire, link, answer, why):
    wire.answer = answer
    with pytest.raises(PlantError, match=why):
        link.start_logs(0.3, lambda: True)


def test_cancellation_is_noticed_without_answer(link):
    with pytest.raises(PlantError, match="aborted"):
        link.start_logs(5.0, lambda: False)


def test_console_messages_are_stored(wire, link):
    wire.inbox.append((Packet(crtp.CONSOLE, 0, b"SYS: low \nbattery\n").pack(), HERE))
    link.pump(0.0)
    assert link.console_text() == "; it said: SYS: low battery"
