"""CRTP, the Crazyflie protocol: little-endian packets with a port, a channel and up to 30 bytes.

The Crazyflie's world frame (x, y and z up) and its body frame (forward, left, up) equal ours. Positive pitch is
nose up on the Crazyflie, which is a negative rotation about our y axis.
"""

import math
import struct
from typing import NamedTuple

import numpy as np

from ...errors import MessageError

CONSOLE, PARAMETERS, MEMORY, LOG, SETPOINT, HIGH_LEVEL, SUPERVISOR, PLATFORM, LINK = 0, 2, 4, 5, 7, 8, 9, 13, 15
LONGEST = 31  # bytes, with the header
TOC, CONTROL, DATA = 0, 1, 2  # channels of LOG
ITEM, INFO = 2, 3  # commands of a table of contents
RESET, CREATE, APPEND, START = 5, 6, 7, 3  # commands of LOG's CONTROL
VARIABLES_PER_PACKET = 9  # largest number of variables in one CREATE or APPEND
LOG_MS = 10  # [ms], unit of the period of START
MANUAL, RELAX = 11, 0  # of SETPOINT's channels 0 and 1
HL_STOP, GO_TO, TAKE_OFF, LAND, GO_TO_LINEAR = 3, 4, 7, 8, 12  # commands of HIGH_LEVEL
NEW_GO_TO, OWN_SUPERVISOR = 8, 12  # first protocol versions with GO_TO_LINEAR, and with the port SUPERVISOR
CAN_ARM, ARMED, _, CAN_FLY, FLYING, TUMBLED, LOCKED, CRASHED = (1 << bit for bit in range(8))
THRUST = (1.0, 65_535.0)  # at 0 the motors stop and the controllers are reset
STATE_LOG = {
    **{f"stateEstimateZ.{name}": "h" for name in ("x", "y", "z", "vx", "vy", "vz")},
    "stateEstimateZ.quat": "I",
    **{f"stateEstimateZ.{name}": "h" for name in ("rateRoll", "ratePitch", "rateYaw")},
}
"""Variables in a block of states, with their types [mm, mm/s, packed quaternion, mrad/s]."""
STATUS_LOG = {"stabilizer.thrust": "f", "supervisor.info": "H", "pm.vbat": "f"}
LOG_TYPES = {"B": 1, "H": 2, "I": 3, "b": 4, "h": 5, "i": 6, "f": 7}
_STATE, _STATUS = (struct.Struct("<" + "".join(block.values())) for block in (STATE_LOG, STATUS_LOG))
_PITCH_UP = np.array([1.0, -1.0, 1.0])
_BITS, _HALF = 511, math.sqrt(0.5)


class Packet(NamedTuple):
    """A received packet, or a packet to send."""

    port: int
    channel: int
    body: bytes = b""

    def pack(self) -> bytes:
        """Return the bytes of the datagram."""
        return bytes([self.port << 4 | 3 << 2 | self.channel]) + self.body


def unpack(data: bytes) -> Packet:
    """Return the packet in a datagram.

    Raises:
        MessageError: The datagram is empty or too long.
    """
    if not 0 < len(data) <= LONGEST:
        raise MessageError(f"{len(data)} bytes are not a packet, which has 1 to {LONGEST}")
    return Packet(data[0] >> 4, data[0] & 3, data[1:])


def rates_setpoint(thrust: int, omega: np.ndarray) -> Packet:
    """Return a setpoint for thrust and body rates.

    Args:
        thrust: 0 to 65535.
        omega: Body rates in our frame [rad/s].
    """
    roll, pitch, yaw = (float(rate) for rate in np.degrees(_PITCH_UP * omega))
    return Packet(SETPOINT, 0, struct.pack("<BfffHB", MANUAL, roll, pitch, yaw, thrust, 1))


def take_off(height: float, yaw: float, duration: float) -> Packet:
    """Return the command packet to take off to a height [m] and heading [rad] in a given time [s]."""
    return Packet(HIGH_LEVEL, 0, struct.pack("<BBff?f", TAKE_OFF, 0, height, yaw, False, duration))


def go_to(p: np.ndarray, yaw: float, duration: float, version: int) -> Packet:
    """Return the command packet to go to a position [m] and heading [rad] in a given time [s]."""
    head = (GO_TO_LINEAR, 0, 0, 0) if version >= NEW_GO_TO else (GO_TO, 0, 0)
    return Packet(HIGH_LEVEL, 0, struct.pack(f"<{len(head)}B5f", *head, *map(float, p), yaw, duration))


def land(height: float, duration: float) -> Packet:
    """Return the command packet to land at a height [m] in a given time [s]."""
    return Packet(HIGH_LEVEL, 0, struct.pack("<BBff?f", LAND, 0, height, 0.0, True, duration))


def stop_planning() -> Packet:
    """Return the command packet that ends the motions of take_off, go_to and land; the motors then stop."""
    return Packet(HIGH_LEVEL, 0, bytes([HL_STOP, 0]))


def relax() -> Packet:
    """Return the packet that ends setpoints, so that other commands take effect; without it, the motors stop."""
    return Packet(SETPOINT, 1, struct.pack("<BI", RELAX, 0))


def arm(yes: bool, version: int) -> Packet:
    """Return the command packet to arm or disarm."""
    port, channel = (SUPERVISOR, 1) if version >= OWN_SUPERVISOR else (PLATFORM, 0)
    return Packet(port, channel, bytes([1, yes]))


def new_block(number: int, variables: list[tuple[str, int]]) -> list[Packet]:
    """Return the command packets that create a log block from the types and numbers of its variables."""
    items = [struct.pack("<BH", LOG_TYPES[kind], item) for kind, item in variables]
    parts = [b"".join(items[k : k + VARIABLES_PER_PACKET]) for k in range(0, len(items), VARIABLES_PER_PACKET)]
    return [Packet(LOG, CONTROL, bytes([APPEND if k else CREATE, number]) + part) for k, part in enumerate(parts)]


def start_block(number: int, period: float) -> Packet:
    """Return the command packet to send a block once per period [s]."""
    return Packet(LOG, CONTROL, bytes([START, number, max(1, round(1e3 * period / LOG_MS))]))


class StateRow(NamedTuple):
    """A state in a log."""

    p: np.ndarray
    """Position in the world frame [m]."""
    R: np.ndarray
    """Attitude, body to world."""
    v: np.ndarray
    """Velocity in the world frame [m/s]."""
    omega: np.ndarray
    """Body rates [rad/s]."""


def state_of(values: bytes) -> StateRow:
    """Return the state in a STATE_LOG block.

    Raises:
        MessageError: The block has a wrong length, or its attitude is invalid.
    """
    if len(values) != _STATE.size:
        raise MessageError(f"{len(values)} bytes are not a state, which has {_STATE.size}")
    *where, quat, roll, pitch, yaw = _STATE.unpack(values)
    place = 1e-3 * np.array(where, dtype=float)
    return StateRow(place[:3], attitude_of(quat), place[3:], 1e-3 * _PITCH_UP * np.array([roll, pitch, yaw]))


def state_values(p: np.ndarray, R: np.ndarray, v: np.ndarray, omega: np.ndarray) -> bytes:
    """Return a STATE_LOG block; the inverse of :func:`state_of`."""
    rows = [np.clip(np.round(1e3 * x), -32_768, 32_767).astype(int).tolist() for x in (p, v, _PITCH_UP * omega)]
    return _STATE.pack(*rows[0], *rows[1], quaternion_of(R), *rows[2])


class Status(NamedTuple):
    """Vehicle status in a log."""

    thrust: float
    """Thrust command from the vehicle's controller, 0 to 65535."""
    info: int
    """Bits from the vehicle's supervisor: CAN_ARM, ARMED and so on."""
    battery: float
    """Battery voltage [V]."""


def status_of(values: bytes) -> Status:
    """Return the status in a STATUS_LOG block.

    Raises:
        MessageError: The block has a wrong length, or its values are not finite.
    """
    if len(values) != _STATUS.size:
        raise MessageError(f"{len(values)} bytes are not a status, which has {_STATUS.size}")
    result = Status(*_STATUS.unpack(values))
    if not (math.isfinite(result.thrust) and math.isfinite(result.battery)):
        raise MessageError("a status that is not finite")
    return result


def attitude_of(word: int) -> np.ndarray:
    """Return an attitude, body to world, from 32 bits: the largest element's index, and the other signs and magnitudes.

    Raises:
        MessageError: The other elements are too large for a unit quaternion.
    """
    from scipy.spatial.transform import Rotation  # local, because it takes as long to import as all of retrim

    largest, q = word >> 30, np.zeros(4)
    for k, i in enumerate(i for i in (3, 2, 1, 0) if i != largest):
        bits = word >> 10 * k
        q[i] = (-1.0 if bits >> 9 & 1 else 1.0) * (bits & _BITS) / _BITS * _HALF
    rest = 1.0 - float(q @ q)
    if rest < 0.24:  # the largest of four elements is at least half the length
        raise MessageError("a packed quaternion whose largest element is not")
    q[largest] = math.sqrt(rest)
    out: np.ndarray = Rotation.from_quat(q).as_matrix()
    return out


def quaternion_of(R: np.ndarray) -> int:
    """Encode an attitude in 32 bits; the inverse of :func:`attitude_of` to within 2 mrad."""
    from scipy.spatial.transform import Rotation  # local for the same reason

    q = Rotation.from_matrix(R).as_quat()
    word = largest = int(np.argmax(np.abs(q)))
    q = -q if q[largest] < 0.0 else q
    for i in (i for i in range(4) if i != largest):
        word = word << 10 | int(q[i] < 0.0) << 9 | min(_BITS, round(_BITS * abs(float(q[i])) / _HALF))
    return word
