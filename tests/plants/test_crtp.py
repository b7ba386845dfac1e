"""The wire format of a Crazyflie: golden vectors from its client, inverses, and refused values."""

import struct

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from retrim.errors import MessageError
from retrim.plants.bridges import crtp
from retrim.plants.bridges.crtp import Packet


@pytest.mark.parametrize(
    ("quaternion", "packed"), [([0.1, -0.2, 0.3, 0.9273618], 3297395929), ([-0.8, 0.2, 0.5, -0.2645751], 689808575)]
)
def test_packed_attitudes_equal_client(quaternion, packed):
    """Values from cflib 0.1.34; elements are x, y, z, w."""
    R = Rotation.from_quat(quaternion).as_matrix()
    assert crtp.quaternion_of(R) == packed
    np.testing.assert_allclose(crtp.attitude_of(packed), R, atol=4e-3)


def test_attitudes_survive_round_trip():
    for q in np.random.default_rng(0).normal(size=(200, 4)):
        R = Rotation.from_quat(q)
        back = Rotation.from_matrix(crtp.attitude_of(crtp.quaternion_of(R.as_matrix())))
        assert (R.inv() * back).magnitude() < 5e-3


def test_states_survive_round_trip_to_a_millimetre():
    rng = np.random.default_rng(1)
    p, v, omega = rng.uniform(-9.0, 9.0, (3, 3))
    R = Rotation.from_rotvec([0.3, -0.2, 2.0]).as_matrix()
    values = crtp.state_values(p, R, v, omega)
    assert len(values) == 22  # of the 26 bytes of a log packet
    for result, true in zip(crtp.state_of(values), (p, R, v, omega), strict=True):
        np.testing.assert_allclose(result, true, atol=5e-3)


def test_rate_setpoint_has_pitch_up_sign():
    """20 deg/s about our y axis (left) is nose down; on the wire, pitch is nose up."""
    data = crtp.rates_setpoint(30_000, np.radians([10.0, 20.0, 30.0])).pack()
    assert data[0] == 7 << 4 | 3 << 2
    assert struct.unpack("<BfffHB", data[1:]) == (
        11,
        pytest.approx(10.0),
        pytest.approx(-20.0),
        pytest.approx(30.0),
        30_000,
        1,
    )


@pytest.mark.parametrize(
    ("packet", "data"),
    [
        (crtp.relax(), "7d 00 00000000"),
        (crtp.stop_planning(), "8c 03 00"),
        (crtp.arm(True, 12), "9d 01 01"),
        (crtp.arm(False, 11), "dc 01 00"),
        (crtp.take_off(1.0, 0.5, 2.0), "8c 07 00 0000803f 0000003f 00 00000040"),
        (crtp.land(0.0, 2.0), "8c 08 00 00000000 00000000 01 00000040"),
        (crtp.go_to(np.ones(3), 0.5, 2.0, 7), "8c 04 00 00 0000803f 0000803f 0000803f 0000003f 00000040"),
        (crtp.go_to(np.ones(3), 0.5, 2.0, 8), "8c 0c 00 00 00 0000803f 0000803f 0000803f 0000003f 00000040"),
        (crtp.start_block(2, 0.05), "5d 03 02 05"),
    ],
)
def test_commands_equal_protocol(packet, data):
    assert packet.pack() == bytes.fromhex(data)
    assert crtp.unpack(packet.pack()) == packet


def test_large_block_is_appended_to():
    orders = crtp.new_block(1, [("h", n) for n in range(10)])
    assert [order.body[0] for order in orders] == [crtp.CREATE, crtp.APPEND]
    assert all(len(order.pack()) <= crtp.LONGEST for order in orders)
    assert b"".join(order.body[2:] for order in orders) == b"".join(struct.pack("<BH", 5, n) for n in range(10))


@pytest.mark.parametrize(
    ("what", "why"),
    [
        (lambda: crtp.unpack(b""), "0 bytes are not a packet"),
        (lambda: crtp.unpack(bytes(32)), "32 bytes are not a packet"),
        (lambda: crtp.state_of(bytes(21)), "21 bytes are not a state"),
        (lambda: crtp.status_of(bytes(9)), "9 bytes are not a status"),
        (lambda: crtp.status_of(struct.pack("<fHf", np.nan, 0, 4.0)), "not finite"),
        (lambda: crtp.attitude_of(0x3FFFFFFF), "largest element is not"),
    ],
)
def test_invalid_values_are_refused(what, why):
    with pytest.raises(MessageError, match=why):
        what()


def test_packets_contain_port_and_channel():
    for port in range(16):
        for channel in range(4):
            packet = Packet(port, channel, b"ab")
            assert crtp.unpack(packet.pack()) == packet
