"""MSP and a board's settings: packets in a damaged stream, modes, sticks for rates, and the hand-over by a switch."""

import itertools
import socket
import struct
import time
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from retrim import ConfigError, MessageError, PlantError, Scenario
from retrim.physics import small
from retrim.plants.bridges import msp, msp_link, msp_plant, vehicle_plant
from retrim.plants.bridges.endpoint import TcpEndpoint, address_of, open_endpoint
from retrim.plants.bridges.msp_board import Board, ThrustCurve, rate_of, stick_of
from retrim.plants.bridges.msp_link import MspLink
from retrim.plants.bridges.msp_plant import MspPlant, msp_address_of
from retrim.plants.bridges.vehicle_state import Reading

BOXES = (0, 1, 2, 50)  # ARM, ANGLE, HORIZON, MSP OVERRIDE
ORDER = bytes([0, 1, 3, 2, 4, 5, 6, 7])  # AETR: throttle on the third receiver channel, yaw on the fourth


def vehicle():
    """Return the vehicle with weakly typed constants, which take the type of their operands."""
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.result_type(float)), small())


def tuning(*, kind=msp.ACTUAL_RATES, throttle_expo=0, limit=0):
    row = bytearray(24)
    row[0] = row[11] = row[12] = 20  # 200 deg/s at the centre
    row[1], row[10], row[13] = 50, 0, 50  # expo
    row[2:5] = bytes([70, 70, 40])
    row[7], row[14], row[22] = throttle_expo, limit, kind
    return bytes(row)


def answers(**other):
    ranges = bytes([0, 0, 32, 48, 50, 1, 32, 48, 1, 2, 32, 48, 0, 0, 0, 0])
    rows = {
        msp.API_VERSION: bytes([0, 1, 46]), msp.FC_VARIANT: b"BTFL", msp.FC_VERSION: bytes([4, 5, 1]),
        msp.BOX_IDS: bytes(BOXES), msp.MODE_RANGES: ranges, msp.RX_MAP: ORDER, msp.RC_TUNING: tuning(),
        msp.RX_CONFIG: b"\x09" + struct.pack("<HHH", 1900, 1500, 1050) + bytes(17), msp.RC_DEADBAND: bytes(5),
        msp.ADVANCED_CONFIG: bytes(6) + struct.pack("<H", 550) + bytes(12),
    }  # fmt: skip
    return rows | {getattr(msp, name): value for name, value in other.items()}


def status(*modes):
    flags = sum(1 << BOXES.index(mode) for mode in modes)
    return bytes(6) + flags.to_bytes(4, "little") + bytes(5) + b"\x00" + b"\x1d" + bytes(4)


# ---- packets


@given(st.lists(st.tuples(st.integers(0, 255), st.binary(max_size=40)), max_size=4), st.binary(max_size=12), st.data())
def test_packets_are_found_in_stream_split_anywhere(messages, noise, data):
    noise = noise.replace(b"$", b"?")
    stream = b"".join(noise + msp.encode(code, payload, msp.ANSWER) for code, payload in messages)
    cuts = sorted(data.draw(st.lists(st.integers(0, len(stream)), max_size=5)))
    parser, result = msp.Parser(), []
    for start, end in zip([0, *cuts], [*cuts, len(stream)], strict=True):
        result += parser.feed(stream[start:end])
    assert [(packet.code, packet.payload) for packet in result] == messages


@given(st.integers(3, 9), st.integers(1, 255))
def test_damaged_packet_is_skipped_and_next_one_is_read(place, bits):
    first = bytearray(msp.encode(105, b"abcd", msp.ANSWER))
    first[place] ^= bits
    parser = msp.Parser()
    list(parser.feed(bytes(first) + bytes(300)))
    assert [p.payload for p in parser.feed(msp.encode(1, b"ok", msp.ANSWER))][-1:] == [b"ok"]


def test_refusal_is_not_an_answer():
    (packet,) = msp.Parser().feed(msp.encode(77, b"", msp.REFUSAL))
    assert packet.refused


def test_modes_are_in_order_of_boxes():
    assert msp.Status.of(status(0, 50), BOXES).modes == {0, 50}
    wide = bytes(6) + bytes(4) + bytes(5) + b"\x01" + b"\x02" + b"\x1d" + bytes(4)
    boxes = tuple(range(100, 140))
    assert msp.Status.of(wide, boxes).modes == {133}
    with pytest.raises(MessageError, match="has 12 bytes"):
        msp.Status.of(bytes(12), BOXES)


# ---- settings


@given(st.floats(-1.0, 1.0), st.floats(0.5, 5.0), st.floats(0.0, 10.0), st.floats(0.0, 1.0))
def test_stick_of_rate_gives_this_rate(stick, centre, more, expo):
    curve = (centre, centre + more, expo)
    assert rate_of(stick_of(rate_of(stick, *curve), *curve), *curve) == pytest.approx(rate_of(stick, *curve), abs=0.02)
    assert rate_of(-stick, *curve) == -rate_of(stick, *curve)


def test_sticks_follow_receiver_map():
    board = Board.of(answers())
    assert board.idle == pytest.approx(0.055)
    np.testing.assert_allclose(np.degrees(board.fastest()), [700.0, 700.0, 400.0])
    rates = board.fastest() * np.array([1.0, -1.0, 1.0])
    channels = board.channels(1.0, rates)
    assert channels == [2000, 1000, 2000, 1000, 1000, 1000, 1000]  # roll, pitch, throttle, yaw (reversed), AUX 1 to 3
    assert board.channels(0.5, np.zeros(3))[:4] == [1500, 1500, 1525, 1500]
    assert board.channels(0.0, np.zeros(3), level=True)[2] == 1000
    assert 1700 < board.channels(0.0, np.zeros(3), level=True)[6] <= 2000


def test_channel_of_angle_mode_is_not_that_of_other_mode():
    shared = bytes([0, 0, 32, 48, 50, 1, 32, 48, 1, 1, 0, 16])
    assert Board.of(answers(MODE_RANGES=shared)).level_channel is None


@pytest.mark.parametrize(
    ("other", "text"),
    [
        ({"FC_VARIANT": b"INAV"}, "firmware is 'INAV', and the link is for Betaflight"),
        ({"RC_TUNING": tuning(kind=0)}, "set rates_type = ACTUAL"),
        ({"RC_TUNING": tuning(throttle_expo=30)}, "set thr_expo = 0"),
        ({"RC_TUNING": tuning(limit=1)}, "set throttle_limit_type = OFF"),
        ({"RC_DEADBAND": bytes([0, 4, 0, 0, 0])}, "set yaw_deadband = 0"),
        ({"BOX_IDS": bytes([0, 1, 2])}, "set msp_override_channels_mask = 15"),
        ({"RC_TUNING": b"short"}, "answers are incomplete: an MSP answer has 5 bytes"),
        ({"RX_MAP": bytes(8)}, r"the receiver's map is \[0, 0, 0, 0\]"),
    ],
)
def test_unsuitable_settings_are_refused_with_remedy(other, text):
    with pytest.raises(PlantError, match=text):
        Board.of(answers(**other))


def test_thrust_curve_passes_through_hover():
    curve = ThrustCurve(vehicle(), 0.055)
    with pytest.raises(PlantError, match="before the vehicle hovers"):
        curve.throttle(9.8)
    with pytest.raises(PlantError, match=r"between 0\.05 and 0\.85"):
        curve.learn([0.95] * 20)
    curve.learn([0.29, 0.31] * 20)
    assert curve.per_mass(0.3) == pytest.approx(9.81, rel=1e-6)
    for c in (2.0, 9.8, 20.0):
        assert curve.per_mass(curve.throttle(c)) == pytest.approx(c, rel=1e-3)
    assert curve.throttle(1e3) == 1.0


# ---- addresses


@pytest.mark.parametrize(
    "text",
    [
        "", "serial:/dev/ttyAMA0:115200", "udp:127.0.0.1:5761,pose=/a", "tcp:127.0.0.1:5761,pose=a",
        "tcp:127.0.0.1:99999,pose=/a", "serial:/dev/ttyAMA0,odometry=/a", "tcp:h:1,pose=/a,odometry=/b",
        "tcp:h:1,pose=cyclonedds@x:1:/a",
    ],
)  # fmt: skip
def test_invalid_addresses_are_refused_before_training(text):
    with pytest.raises(ConfigError, match="expected"):
        Scenario(plant=f"msp:{text}" if text else "msp")


def test_address_has_port_and_topic():
    port, states = msp_address_of("serial:/dev/ttyAMA0:115200,odometry=zenoh@10.0.0.7:7447:/vio/odom")
    assert port == "serial:/dev/ttyAMA0:115200"
    assert (states.backend, states.router, states.odometry, states.pose) == ("zenoh", "10.0.0.7:7447", "/vio/odom", "")


def test_refused_connection_gives_one_line():
    with pytest.raises(PlantError, match=r"tcp:127\.0\.0\.1:9 cannot be connected to"):
        TcpEndpoint("127.0.0.1", 9)
    with pytest.raises(ConfigError, match="expected udp:HOST:PORT"):
        address_of("tcp:127.0.0.1:5761")


def test_bytes_pass_in_both_directions():
    with socket.create_server(("127.0.0.1", 0)) as server:
        end = open_endpoint(f"tcp:127.0.0.1:{server.getsockname()[1]}")
        other, _ = server.accept()
        assert end.receive() is None
        end.send(b"there", "line")
        assert other.recv(10) == b"there"
        other.sendall(b"back")
        time.sleep(0.05)
        assert end.receive() == (b"back", "line")
        other.close()
        end.close()


# ---- a flight with a board and a pilot of a few lines


class FakeBoard:
    """A board that answers requests immediately, and follows the override if its switch is on and its mask permits."""

    def __init__(self, *, follows=True, **other):
        self.rows, self.follows, self.modes = answers(**other), follows, {msp.ARM}
        self.pilot, self.sent = [1500, 1500, 1500, 1335], None  # the firmware's order: roll, pitch, yaw, throttle
        self.inbox, self.received, self.is_silent = b"", [], False
        self.near, self.far = socket.socketpair()

    def fileno(self):
        return self.near.fileno()

    def send(self, data, to):
        if self.is_silent:
            return
        for code, payload in requests(data):
            if code == msp.SET_RAW_RC:
                self.sent = msp.numbers(payload)
                self.received.append(self.sent)
            answer = self.rows.get(code, b"")
            if code == msp.STATUS_EX:
                answer = status(*self.modes)
            if code == msp.RC:
                ours = self.follows and msp.OVERRIDE in self.modes and self.sent is not None
                row = [self.sent[ORDER[axis]] for axis in range(4)] if ours else self.pilot
                answer = struct.pack("<8H", *row, 2000, 1000, 1000, 1000)
            self.inbox += msp.encode(code, answer, msp.ANSWER)

    def receive(self):
        data, self.inbox = self.inbox, b""
        return (data, "line") if data else None

    def close(self):
        self.near.close()


def requests(data):
    while data:
        size, code = data[3], data[4]
        yield code, data[5 : 5 + size]
        data = data[6 + size :]


class FakeStates(SimpleNamespace):
    """Motion capture of a vehicle at rest in the air."""

    def __init__(self, p=(0.0, 0.0, 1.0)):
        super().__init__(p=np.array(p), notes=[], is_seen=True, rate=100.0)

    @property
    def reading(self):
        return Reading(time.monotonic() - 0.005, self.p, np.eye(3), np.zeros(3), np.zeros(3))

    @property
    def last_message(self):
        return time.monotonic() - (0.0 if self.is_seen else 5.0)

    def close(self):
        pass


@pytest.fixture
def make(monkeypatch):
    """Return a function that builds a plant, its board and its states."""
    open_boards = []

    def build(**other):
        board, states = FakeBoard(**other), FakeStates()
        monkeypatch.setattr(msp_plant, "open_endpoint", lambda address: board)
        monkeypatch.setattr(msp_plant, "connect_link", lambda where, kind: states)
        monkeypatch.setattr(msp_plant, "await_states", lambda link, until, keep_on: None)
        monkeypatch.setattr(vehicle_plant, "ARRIVAL_S", 0.2)
        monkeypatch.setattr(msp_plant, "HOVER_S", 0.4)
        monkeypatch.setattr(msp_link, "REQUEST_PERIOD_S", 0.01)  # five answers come in 0.4 s, also on a busy machine
        limit = np.array([30.0, 10.0, 10.0, 4.0])
        low = np.array([0.0, *-limit[1:]])
        plant = MspPlant("tcp:127.0.0.1:1,pose=/p", 0.02, low, limit, vehicle())
        open_boards.append((plant, board))
        return plant, board, states

    yield build
    for plant, board in open_boards:
        plant.stop()
        board.far.close()


def hand_over(plant, board):
    """Take off, with a pilot who turns the switch after the hover."""

    def turn():
        if plant.curve.hover is not None:
            board.modes.add(msp.OVERRIDE)
        return True

    plant.connect()
    plant.take_off(np.array([0.0, 0.0, 1.0]), 0.0, turn)


def read_for(plant, seconds):
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        plant.read()
        plant.wait(time.monotonic() + 0.02)


def test_board_receives_pilot_sticks_before_hand_over(make):
    plant, board, _ = make()
    plant.connect()
    plant.wait(time.monotonic() + 0.2)
    assert board.sent[:4] == [1500, 1500, 1335, 1500]


def test_hover_throttle_is_learned_from_pilot_and_switch_hands_over(make):
    plant, board, _ = make()
    hand_over(plant, board)
    assert plant.curve.hover == pytest.approx((1335 - 1050) / 950)
    u = plant.transmit(np.array([9.81, 1.0, 0.0, 0.0]))
    np.testing.assert_allclose(u, [9.81, 1.0, 0.0, 0.0], rtol=1e-6)
    assert board.sent[2] == 1335
    assert board.sent[0] > 1500


def test_switch_that_is_on_too_early_must_be_turned_off(make):
    """The board has no valid commands before the pilot has hovered."""
    plant, board, _ = make()
    board.modes.add(msp.OVERRIDE)
    began, remarks, off, hover_times = time.monotonic(), [], 1.5, []

    def turn():
        t = time.monotonic() - began
        remarks.append((t, plant.waits_for))
        if plant.curve.hover is not None:
            hover_times.append(t)
        is_on = t < off or (hover_times and t > hover_times[0] + 0.3)
        (board.modes.add if is_on else board.modes.discard)(msp.OVERRIDE)
        return True

    plant.connect()
    plant.take_off(np.array([0.0, 0.0, 1.0]), 0.0, turn)
    assert hover_times[0] > off
    assert time.monotonic() - began > hover_times[0] + 0.3
    assert all("turn it off" in text for t, text in remarks if 0.5 < t < off)
    assert not any(text for t, text in remarks if t > off + 0.5)
    assert plant.curve.hover == pytest.approx((1335 - 1050) / 950)


def test_pilot_has_control_as_soon_as_switch_is_off(make):
    plant, board, _ = make()
    hand_over(plant, board)
    board.modes.discard(msp.OVERRIDE)
    with pytest.raises(PlantError, match="the pilot has switched MSP OVERRIDE off"):
        read_for(plant, 0.4)
    sent = len(board.received)
    plant.stop()
    assert len(board.received) == sent


def test_unsuitable_mask_is_found_at_hand_over(make):
    plant, board, _ = make(follows=False)
    with pytest.raises(PlantError, match="set msp_override_channels_mask to 15"):
        hand_over(plant, board)


def test_angle_mode_is_refused_at_hand_over(make):
    plant, board, _ = make()
    board.modes.add(msp.ANGLE)
    with pytest.raises(PlantError, match="body rates need ACRO"):
        hand_over(plant, board)


def test_silent_board_ends_flight(make):
    plant, board, _ = make()
    hand_over(plant, board)
    board.is_silent = True
    with pytest.raises(PlantError, match=r"the board has been silent for 0\.5 s"):
        read_for(plant, 1.2)


def test_board_without_answer_gives_one_line(make, monkeypatch):
    monkeypatch.setattr("retrim.plants.bridges.msp_link.ANSWERS_S", 0.3)
    plant, board, _ = make()
    board.is_silent = True
    with pytest.raises(PlantError, match=r"the board does not answer MSP requests .* is MSP on this port"):
        plant.connect()


def test_motors_stop_on_ground_and_guardian_takes_over_in_air(make):
    plant, board, states = make()
    hand_over(plant, board)
    states.p = np.array([0.0, 0.0, 0.1])
    plant.stop()
    assert board.sent[2] == 1000
    plant, board, states = make()
    hand_over(plant, board)
    guardian = plant._guardian
    plant.stop()  # a metre above the ground
    board.far.settimeout(2.0)
    (code, payload), *_ = requests(board.far.recv(4096))
    channels = msp.numbers(payload)
    assert code == msp.SET_RAW_RC
    assert 1200 < channels[2] < 1335  # it sinks
    assert channels[6] > 1700  # ANGLE
    guardian.process.kill()


def test_missing_states_end_flight(make):
    plant, board, states = make()
    hand_over(plant, board)
    states.is_seen = False
    with pytest.raises(PlantError, match=r"no state has come for 1\.5 s"):
        plant.read()


def test_lost_answer_does_not_stop_requests(make):
    plant, board, _ = make()
    plant.connect()
    lost = []

    def drop(data, to, send=board.send):
        send(data, to)
        if data[4] == msp.SET_RAW_RC and len(lost) < 5:
            lost.append(data)
            board.inbox = b""

    board.send = drop
    assert plant.until(lambda: len(lost) == 5, 10.0, lambda: True)
    plant.link.throttles.clear()
    assert plant.until(lambda: len(plant.link.throttles) > 3, 10.0, lambda: True)
    assert plant.link.lag < 0.1


def test_late_board_ends_flight(make):
    """Otherwise commands would wait in its buffer and act with a growing delay."""
    plant, board, _ = make()
    hand_over(plant, board)
    late, count = [], itertools.count()

    def queue(data, to, send=board.send):
        late.append(data)
        if next(count) % 3:
            send(late.pop(0), to)

    board.send = queue
    with pytest.raises(PlantError, match="set serial_update_rate_hz = 500"):
        fly_for(plant, 4.0)


def fly_for(plant, seconds):
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        plant.read()
        plant.transmit(np.array([9.81, 0.0, 0.0, 0.0]))
        plant.wait(time.monotonic() + 0.02)


def test_link_counts_damaged_packets():
    board = FakeBoard()
    link = MspLink(board, FakeStates())
    data = bytearray(msp.encode(1, b"abc", msp.ANSWER))
    data[-1] ^= 1
    board.inbox = bytes(data)
    link.pump(0.0)
    assert link.notes == ["damaged MSP packets"]
    board.far.close()
    link.close()
