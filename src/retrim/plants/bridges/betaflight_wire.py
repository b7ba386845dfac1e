"""UDP packets to and from Betaflight's simulated board (SITL, 4.6), little endian."""

import math
import struct
from collections.abc import Sequence

import numpy as np

from ...errors import MessageError
from ...physics.state import STANDARD_GRAVITY

MOTORS, STATE, STICKS, CLI = 9002, 9003, 9004, 5761  # ports: the board sends motors, and listens on the others
CENTRE, SPAN, LOW, HIGH = 1500, 500, 1000, 2000  # [us], stick positions
THROTTLE_FROM, THROTTLE_SPAN = 1050.0, 950.0  # [us]: start and length of the throttle range
IDLE = 0.055  # smallest share of a motor's range while the board is armed
CHANNELS, ARM = 16, 4  # number of receiver channels, and index of the one that arms
REST = np.array([0.0, 0.0, STANDARD_GRAVITY])
LEVEL = np.eye(3)
GYRO = np.array([1.0, -1.0, -1.0])  # from forward-left-up body rates
RATE_STICKS = np.array([1.0, 1.0, -1.0])  # roll, pitch and yaw up, from forward-left-up body rates
OUR_ROTORS = [0, 1, 3, 2]  # the board's are front-right, back-left, front-left, back-right; our last two are swapped
_STATE, _STICKS, _MOTORS = struct.Struct("<18d"), struct.Struct("<d16H"), struct.Struct("<4f")


def state_packet(omega: np.ndarray, specific_force: np.ndarray = REST, R: np.ndarray = LEVEL) -> bytes:
    """Return a packet with body rates, a specific force and an attitude; in rate mode a board flies by the rates alone.

    The time stamp is constant, so the board uses its own clock, which the jitter of varying stamps would disturb.

    Args:
        omega: Body rates, forward-left-up [rad/s].
        specific_force: Specific force, forward-left-up [m/s^2], which the board writes to its Blackbox.
        R: Attitude, body to world, by which the board levels the vehicle in ANGLE mode.
    """
    (a, b, c), (d, e, f), (g, h, i) = R.tolist()
    w = math.sqrt(max(1e-6, 1.0 + a + e + i))  # twice the first number; exact up to half a turn
    q = (0.5 * w, 0.5 * (h - f) / w, 0.5 * (c - g) / w, 0.5 * (d - b) / w)
    return _STATE.pack(1.0, *(GYRO * omega), *-specific_force, *q, *(0.0,) * 6, 101325.0)


def sticks_packet(
    throttle: float, omega: np.ndarray, fastest: float, *, armed: bool, switches: Sequence[int] = ()
) -> bytes:
    """Return a receiver packet.

    Args:
        throttle: Throttle, 0 to 1; at 0 the stick is at its lower end, which arming requires.
        omega: Body rates, forward-left-up [rad/s].
        fastest: Body rate at full stick [rad/s].
        armed: Whether the arming switch is on.
        switches: Channels after the one that arms [us]; the others are low.
    """
    roll, pitch, yaw = np.clip(CENTRE + SPAN * RATE_STICKS * omega / fastest, LOW, HIGH).round().astype(int)
    up = round(float(np.clip(THROTTLE_FROM + THROTTLE_SPAN * throttle, LOW, HIGH))) if throttle > 0.0 else LOW
    channels = [int(roll), int(pitch), up, int(yaw)] + [LOW] * (CHANNELS - ARM)
    channels[ARM] = HIGH if armed else LOW
    channels[ARM + 1 : ARM + 1 + len(switches)] = switches
    return _STICKS.pack(1.0, *channels)


def motors_of(packet: bytes) -> np.ndarray:
    """Return the four motor commands in a packet, 0 to 1, in the order of our rotors.

    Raises:
        MessageError: The bytes are not a motor packet.
    """
    if len(packet) != _MOTORS.size:
        raise MessageError(f"{len(packet)} bytes are not a packet of motors, which has {_MOTORS.size}")
    motors = np.array(_MOTORS.unpack(packet))
    if not (np.isfinite(motors).all() and (motors >= 0.0).all() and (motors <= 1.0).all()):
        raise MessageError(f"motors {motors.tolist()} are not all between 0 and 1")
    return motors[OUR_ROTORS]


def throttle_of(motor: float) -> float:
    """Return the throttle, 0 to 1, at which every motor command is ``motor``."""
    return float(np.clip((motor - IDLE) / (1.0 - IDLE), 0.0, 1.0))


def settings(steps: int) -> list[str]:
    """Return the settings for a board in rate mode, with a receiver and without stick smoothing.

    Args:
        steps: Body rate at full stick, in units of 10 deg/s.
    """
    rates = [f"set {axis}_{name} = {value}" for axis in ("roll", "pitch", "yaw")
             for name, value in (("rc_rate", steps), ("srate", steps), ("expo", 0))]  # fmt: skip
    return [
        "feature -GPS", "set small_angle = 180", "set pwr_on_arm_grace = 0", "set rc_smoothing = OFF",
        "set rates_type = ACTUAL", *rates, "aux 0 0 0 1700 2100 0 0",
    ]  # fmt: skip
