"""The MAVLink link: accepted messages, accepted senders, and sent messages."""

import math
import time

import numpy as np
import pytest

from fake_wire import Wire
from retrim.plants.bridges import frames
from retrim.plants.bridges.mavlink_link import MavlinkLink

mavlink = pytest.importorskip("pymavlink.dialects.v20.common")
PX4, INVALID = 12, 8
HERE = ("127.0.0.1", 14580)
TURNED = np.array([0.9, 0.1, -0.2, math.sqrt(1 - 0.81 - 0.01 - 0.04)])


@pytest.fixture
def wire():
    setup = Wire()
    yield setup
    setup.close()


class Sender:
    """A MAVLink sender."""

    def __init__(self, wire, link, *, system=1, component=1, peer=HERE):
        self.out = mavlink.MAVLink(None, srcSystem=system, srcComponent=component)
        self.wire, self.link, self.peer = wire, link, peer

    def says(self, *messages):
        for message in messages:
            self.wire.inbox.append((message.pack(self.out), self.peer))
        self.link.pump(0.0)

    def alive(self, autopilot=PX4, mode=(6, 0), armed=True):
        custom = mode[0] << 16 | mode[1] << 24
        self.says(self.out.heartbeat_encode(2, autopilot, 0x80 if armed else 0, custom, 4))

    def odometry(self, p=(1.0, 2.0, -3.0), q=TURNED, v=(0.1, 0.2, 0.3), rates=(0.4, 0.5, 0.6), frame=1, child=1, us=0):
        nan = [math.nan] * 21
        self.says(self.out.odometry_encode(us, frame, child, *p, list(q), *v, *rates, nan, nan))


@pytest.fixture
def link(wire):
    return MavlinkLink(wire)


@pytest.fixture
def px4(wire, link):
    speaker = Sender(wire, link)
    speaker.alive()
    return speaker


def parse_replies(wire):
    """Return the sent messages, read by an independent parser."""
    parser = mavlink.MAVLink(None)
    return [m for data, _ in wire.packets for m in parser.parse_buffer(data) or []]


def read_messages(wire, kind):
    return [m for m in parse_replies(wire) if m.get_type() == kind]


def test_first_autopilot_is_selected(wire, link):
    Sender(wire, link, system=255).alive(INVALID)  # a ground station
    assert link.system is None
    Sender(wire, link, system=3).alive()
    assert (link.system, link.autopilot, link.mode, link.armed) == ((3, 1), PX4, (6, 0), True)
    Sender(wire, link, system=4).alive(mode=(4, 6))
    Sender(wire, link, system=3, peer=("127.0.0.1", 9)).alive(mode=(4, 6))
    assert (link.system, link.mode, link.ignored) == ((3, 1), (6, 0), 3)


def test_state_is_converted_to_retrim_frames(px4, link):
    px4.odometry()
    np.testing.assert_allclose(link.reading.p, [2.0, 1.0, 3.0], atol=1e-6)
    np.testing.assert_allclose(link.reading.v, [0.2, 0.1, -0.3], atol=1e-6)
    np.testing.assert_allclose(link.reading.omega, [0.4, -0.5, -0.6], atol=1e-6)
    np.testing.assert_allclose(link.reading.R, frames.attitude_of(TURNED), atol=1e-6)


def test_body_velocity_is_converted(px4, link):
    px4.odometry()
    world, R = link.reading.v, link.reading.R
    px4.odometry(v=frames.turn_body(R.T @ world), child=12)
    np.testing.assert_allclose(link.reading.v, world, atol=1e-6)


def test_simultaneous_position_and_attitude_give_state(px4, link):
    place = px4.out.local_position_ned_encode(1000, 1.0, 2.0, -3.0, 0.1, 0.2, 0.3)
    px4.says(place)
    assert link.reading is None
    px4.says(px4.out.attitude_quaternion_encode(900, *TURNED, 0.4, 0.5, 0.6), place)
    assert link.reading is None  # 0.1 s apart
    px4.says(px4.out.attitude_quaternion_encode(1010, *TURNED, 0.4, 0.5, 0.6), place)
    np.testing.assert_allclose(link.reading.p, [2.0, 1.0, 3.0], atol=1e-6)
    np.testing.assert_allclose(link.reading.omega, [0.4, -0.5, -0.6], atol=1e-6)


def test_messages_in_unknown_frames_are_counted_and_reported_once(px4, link):
    px4.odometry()
    before = link.reading
    for frame in range(256):
        if frame not in (1, 20):
            px4.odometry(p=(7.0, 7.0, 7.0), frame=frame)
    for child in (0, 2, 9, 255):
        px4.odometry(p=(7.0, 7.0, 7.0), child=child)
    for _ in range(3):
        px4.odometry(p=(7.0, 7.0, 7.0), frame=7)
    assert link.reading is before
    assert link.ignored == 254 + 4 + 3
    assert link.notes[0] == "ODOMETRY in frame 0; only LOCAL_NED (1) and LOCAL_FRD (20) are known"
    assert len(set(link.notes)) == len(link.notes) == 5
    px4.odometry(p=(4.0, 5.0, -6.0), frame=20)
    np.testing.assert_allclose(link.reading.p, [5.0, 4.0, 6.0], atol=1e-6)


def frame_packet(kind, payload):
    """Return a complete packet of any message type with any content."""
    head = bytes([len(payload), 0, 0, 0, 1, 1]) + kind.id.to_bytes(3, "little")
    crc = mavlink.x25crc(head + payload + bytes([kind.crc_extra])).crc
    return b"\xfd" + head + payload + crc.to_bytes(2, "little")


def test_no_message_of_dialect_ends_flight(px4, wire, link):
    rng = np.random.default_rng(0)
    for kind in mavlink.mavlink_map.values():
        length = kind.unpacker.size
        for payload in (bytes(length), b"\xff" * length, *(rng.bytes(length) for _ in range(8))):
            wire.inbox.append((frame_packet(kind, payload), px4.peer))
        link.pump(0.0)
    assert link.system == (1, 1)
    assert link.reading is None or np.isfinite(link.reading.p).all()
    px4.odometry(p=(4.0, 5.0, -6.0))
    assert link.reading is not None


@pytest.mark.parametrize(
    "wrong",
    [{"p": (math.nan, 0.0, 0.0)}, {"v": (0.0, math.inf, 0.0)}, {"q": (0.0, 0.0, 0.0, 0.0)}, {"q": (9, 0, 0, 0)}],
)
def test_implausible_state_is_ignored(px4, link, wrong):
    px4.odometry()
    before = link.reading
    px4.odometry(**wrong)
    assert link.reading is before
    assert link.ignored == 1


def test_stamps_are_converted_to_local_clock(px4, wire, link):
    began = time.monotonic()
    for _ in range(12):
        link.pump(time.monotonic() + 0.03)
        for calls in read_messages(wire, "TIMESYNC"):
            if calls.tc1 == 0:
                remote = 50.0 + 0.99 * (1e-9 * calls.ts1 - began)
                px4.says(px4.out.timesync_encode(int(1e9 * remote), calls.ts1))
        wire.packets.clear()
    sending = time.monotonic()
    px4.odometry(us=int(1e6 * (50.0 + 0.99 * (sending - 0.2 - began))))
    assert link.reading.stamp == pytest.approx(sending - 0.2, abs=0.01)


def test_heartbeat_is_sent(px4, wire, link):
    link.pump(time.monotonic() + 1.2)
    assert 2 <= len(read_messages(wire, "HEARTBEAT")) <= 4
    assert len(read_messages(wire, "TIMESYNC")) >= 8
    assert {to for _, to in wire.packets} == {HERE}


def test_nothing_is_sent_without_receiver(wire, link):
    link.pump(time.monotonic() + 0.1)
    link.fly_rates(0.5, np.zeros(3))
    link.fly_to(np.zeros(3), 0.0)
    link.command(400, 1.0)
    assert wire.packets == []


def test_commands_are_converted_to_px4_frames(px4, wire, link):
    link.fly_rates(0.4, np.array([0.1, 0.2, 0.3]))
    (rates,) = read_messages(wire, "SET_ATTITUDE_TARGET")
    assert rates.type_mask == 128
    message = [rates.thrust, rates.body_roll_rate, rates.body_pitch_rate, rates.body_yaw_rate]
    assert message == pytest.approx([0.4, 0.1, -0.2, -0.3])
    link.fly_to(np.array([1.0, 2.0, 3.0]), 0.0)
    (place,) = read_messages(wire, "SET_POSITION_TARGET_LOCAL_NED")
    assert [place.x, place.y, place.z, place.yaw] == pytest.approx([2.0, 1.0, -3.0, math.pi / 2])


def damage(rng, whole, *, kinds=5):
    """Return a damaged packet."""
    kind = rng.integers(kinds)
    packet = bytearray(whole[rng.integers(len(whole))])
    if kind == 0:
        return bytes(rng.integers(0, 256, rng.integers(0, 300), dtype=np.uint8))
    if kind == 1:
        return bytes(packet[: rng.integers(0, len(packet))])
    if kind == 2:
        return b"\xfd" + bytes(rng.integers(0, 256, rng.integers(0, 280), dtype=np.uint8))
    if kind == 3:
        packet[rng.integers(len(packet))] ^= 1 << rng.integers(8)
        return bytes(packet)
    # on a serial line, the end of a packet that was truncated earlier
    return bytes(packet[rng.integers(1, len(packet)) :])


@pytest.mark.parametrize("datagrams", [True, False])
def test_2000_damaged_packets_are_refused(wire, datagrams):
    link, rng = MavlinkLink(wire, datagrams=datagrams), np.random.default_rng(0)
    px4 = Sender(wire, link)
    px4.alive()
    px4.odometry()
    out = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    nan = [math.nan] * 21
    whole = [
        m.pack(out)
        for m in (
            out.heartbeat_encode(2, PX4, 0, 4 << 16, 4),
            out.odometry_encode(1, 1, 1, 7, 7, 7, [1.0, 0.0, 0.0, 0.0], 7, 7, 7, 7, 7, 7, nan, nan),
            out.attitude_target_encode(1, 0, [1.0, 0.0, 0.0, 0.0], 0, 0, 0, 0.9),
            out.statustext_encode(6, b"believe me"),
        )
    ]
    before = link.reading
    for _ in range(2000):
        wire.inbox.append((damage(rng, whole, kinds=5 if datagrams else 4), HERE))
        link.pump(0.0)
    assert link.reading is before
    assert (link.mode, link.armed, list(link.thrusts), list(link.texts)) == ((6, 0), True, [], [])
    assert link.ignored > 500
    for _ in range(20 if not datagrams else 1):  # on a serial line, damage may consume the following bytes
        px4.odometry(p=(4.0, 5.0, -6.0))
    np.testing.assert_allclose(link.reading.p, [5.0, 4.0, 6.0], atol=1e-6)
