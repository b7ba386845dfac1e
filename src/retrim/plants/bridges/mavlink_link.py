"""Connect to an autopilot by MAVLink, receive its state and send commands.

This module does not decide when to arm or which controller flies; :mod:`.mavlink` does.
"""

import math
import time
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np

from ..extras import import_extra
from . import frames
from .clock import RemoteClock
from .endpoint import Endpoint, pump
from .vehicle_state import Reading

HEARTBEAT_S, SYNC_S = 0.5, 0.1
PREARM = 0x10000000  # bit of SYS_STATUS: arming is possible
ARMED = 0x80  # bit of HEARTBEAT.base_mode
ONBOARD_COMPUTER, INVALID = 18, 8  # MAV_TYPE, MAV_AUTOPILOT
LOCAL_NED, LOCAL_FRD, BODY_FRD, BODY_NED = 1, 20, 12, 8
WORLDS, BODIES = (LOCAL_NED, LOCAL_FRD), (BODY_FRD, BODY_NED)
VISION = 2  # MAV_ESTIMATOR_TYPE
RATES_ONLY = 128  # SET_ATTITUDE_TARGET: use thrust and body rates, ignore the attitude
PLACE_AND_YAW = 0x9F8  # SET_POSITION_TARGET_LOCAL_NED: ignore velocity, acceleration and yaw rate
PAIRING_S = 0.025  # [s], largest time between a position and an attitude that are combined into a state
MOST_NOTES = 5
ODOMETRY_TIMEOUT_S = 1.0  # [s] without ODOMETRY, after which other messages are used instead


class MavlinkLink:
    """Receives messages, stores the newest message of each kind, and keeps the connection alive."""

    def __init__(self, endpoint: Endpoint, *, datagrams: bool = True) -> None:
        """Build one end of a connection.

        Args:
            endpoint: Endpoint for received and sent bytes. The link communicates with the first autopilot from which it
                receives a message, and ignores all other senders.
            datagrams: Whether every message arrives in one piece; a damaged datagram then does not affect the next one.

        Raises:
            PlantError: pymavlink is not installed.
        """
        self._dialect: Any = import_extra("pymavlink.dialects.v20.common", "mavlink", package="pymavlink")
        self._endpoint, self._datagrams = endpoint, datagrams
        self._sender = self._dialect.MAVLink(None, srcSystem=1, srcComponent=191)
        self._parser = self._fresh()
        self._peer: Any = None
        self._clock = RemoteClock()
        self._due = {"heartbeat": 0.0, "sync": 0.0}
        self._attitude: Any = None
        self._odometry_at = -math.inf
        self.system: tuple[int, int] | None = None
        """System and component number of the autopilot; None until its first message."""
        self.autopilot, self.mode, self.armed, self.ready = -1, (0, 0), False, False
        self.reading: Reading | None = None
        self.truth: Reading | None = None
        """True state from the autopilot's own simulator, if it is reported; the origin is the first position."""
        self.thrusts: deque[float] = deque(maxlen=50)
        """The autopilot's thrust commands to its motors, as shares of the full thrust."""
        self.texts: deque[str] = deque(maxlen=20)
        """Text messages from the autopilot."""
        self.last_message = -math.inf
        """Time of the autopilot's last message, on the monotonic clock [s]."""
        self.ignored = 0
        """Number of messages that were damaged, implausible or from other senders."""
        self.notes: list[str] = []
        """Kinds of ignored messages from the autopilot, each listed once."""
        self._origin: tuple[float, float, float] | None = None
        self._takes: dict[str, Callable[[Any, float], None]] = {
            "HEARTBEAT": self._heartbeat, "SYS_STATUS": self._sys_status, "TIMESYNC": self._timesync,
            "ODOMETRY": self._odometry, "ATTITUDE_QUATERNION": self._attitude_quaternion,
            "LOCAL_POSITION_NED": self._local_position, "ATTITUDE_TARGET": self._attitude_target,
            "STATUSTEXT": self._text, "HIL_STATE_QUATERNION": self._hil_state,
        }  # fmt: skip

    def pump(self, until: float) -> None:
        """Read received messages and send periodic ones until an instant on the monotonic clock [s]."""
        pump(self._endpoint, until, self._chores, self._take)

    def command(self, number: int, *parameters: float) -> None:
        """Send COMMAND_LONG; the first answer only confirms arrival, and the autopilot's state shows the effect."""
        values = (*parameters, *([0.0] * (7 - len(parameters))))
        if self.system is not None:
            self._send(self._sender.command_long_encode(*self.system, number, 0, *values))

    def stream(self, message: str, rate: float) -> None:
        """Request a message at a rate [Hz]."""
        number = getattr(self._dialect, f"MAVLINK_MSG_ID_{message}")
        self.command(self._dialect.MAV_CMD_SET_MESSAGE_INTERVAL, float(number), 1e6 / rate)

    def fly_rates(self, thrust: float, omega: np.ndarray) -> None:
        """Send SET_ATTITUDE_TARGET.

        Args:
            thrust: Share of the motors' thrust, 0 to 1.
            omega: Body rates in our frame [rad/s].
        """
        if self.system is not None:
            rates = frames.turn_body(omega)
            self._send(self._sender.set_attitude_target_encode(
                0, *self.system, RATES_ONLY, [1.0, 0.0, 0.0, 0.0], *map(float, rates), float(thrust)
            ))  # fmt: skip

    def fly_to(self, p: np.ndarray, yaw: float) -> None:
        """Send SET_POSITION_TARGET_LOCAL_NED.

        Args:
            p: Target position in our world frame [m].
            yaw: Target heading in our convention [rad].
        """
        if self.system is not None:
            place = [float(x) for x in frames.turn_world(p)]
            self._send(self._sender.set_position_target_local_ned_encode(
                0, *self.system, LOCAL_NED, PLACE_AND_YAW, *place, 0, 0, 0, 0, 0, 0, frames.turn_heading(yaw), 0
            ))  # fmt: skip

    def see(self, x: Reading) -> None:
        """Send ODOMETRY: a state measured by motion capture, for the autopilot's estimator.

        Args:
            x: The state; the time stamp is not sent, since the message is sent immediately.
        """
        place = [float(each) for each in frames.turn_world(x.p)]
        velocity = [float(each) for each in frames.turn_body(x.R.T @ x.v)]
        rates = [float(each) for each in frames.turn_body(x.omega)]
        unknown = [math.nan] * 21
        self._send(self._sender.odometry_encode(
            0, LOCAL_NED, BODY_FRD, *place, frames.quaternion_of(x.R).tolist(), *velocity, *rates, unknown, unknown,
            0, VISION, 100,
        ))  # fmt: skip

    def close(self) -> None:
        """Close the port."""
        self._endpoint.close()

    def _fresh(self) -> Any:
        parser = self._dialect.MAVLink(None)
        parser.robust_parsing = True
        return parser

    def _send(self, message: Any) -> None:
        if self._peer is not None:
            self._endpoint.send(message.pack(self._sender), self._peer)

    def _chores(self, now: float) -> None:
        if now >= self._due["heartbeat"]:
            self._due["heartbeat"] = now + HEARTBEAT_S
            self._send(self._sender.heartbeat_encode(ONBOARD_COMPUTER, INVALID, 0, 0, 4))
        if now >= self._due["sync"]:
            self._due["sync"] = now + SYNC_S
            self._send(self._sender.timesync_encode(0, int(time.monotonic() * 1e9)))

    def _take(self, data: bytes, peer: Any) -> None:
        """Process the data of one read."""
        if self._datagrams:
            self._parser = self._fresh()
        now = time.monotonic()
        try:
            messages = self._parser.parse_buffer(data) or []
        except Exception:  # a parser may raise any error on malicious bytes
            self._parser, messages, self.ignored = self._fresh(), [], self.ignored + 1
        for message in messages:
            if self._is_valid(message, peer):
                self.last_message = now
                take = self._takes.get(message.get_type())
                if take is not None:
                    try:
                        take(message, now)
                    except (ArithmeticError, LookupError, TypeError, ValueError) as error:  # go on after a bad message
                        self._ignore(f"{message.get_type()} that makes no sense ({type(error).__name__})")
            else:
                self.ignored += 1

    def _is_valid(self, message: Any, peer: Any) -> bool:
        """Return whether a message is intact and from the autopilot; the first autopilot that sends is selected."""
        kind = message.get_type()
        if kind == "BAD_DATA" or kind.startswith("UNKNOWN"):
            return False
        who = message.get_srcSystem(), message.get_srcComponent()
        if self.system is None and kind == "HEARTBEAT" and message.autopilot != INVALID:
            self.system, self._peer = who, peer
        return who == self.system and peer == self._peer

    def _heartbeat(self, message: Any, now: float) -> None:
        self.autopilot = int(message.autopilot)
        self.mode = (message.custom_mode >> 16 & 0xFF, message.custom_mode >> 24 & 0xFF)
        self.armed = bool(message.base_mode & ARMED)

    def _sys_status(self, message: Any, now: float) -> None:
        self.ready = bool(message.onboard_control_sensors_health & PREARM)

    def _timesync(self, message: Any, now: float) -> None:
        if message.tc1 == 0:  # a request from the autopilot
            self._send(self._sender.timesync_encode(int(now * 1e9), message.ts1))
        elif 0.0 <= (trip := now - 1e-9 * message.ts1) < 1.0:
            self._clock.record_exchange(now - trip, 1e-9 * message.tc1, now)

    def _odometry(self, message: Any, now: float) -> None:
        frame, child = message.frame_id, message.child_frame_id
        if frame not in WORLDS:
            self._ignore(f"ODOMETRY in frame {frame}; only LOCAL_NED (1) and LOCAL_FRD (20) are known")
            return
        if child not in (*WORLDS, *BODIES):
            self._ignore(f"ODOMETRY with velocities in frame {child}; only 1, 8, 12 and 20 are known")
            return
        q, v = np.array(message.q), np.array([message.vx, message.vy, message.vz])
        rates = np.array([message.rollspeed, message.pitchspeed, message.yawspeed])
        p = np.array([message.x, message.y, message.z])
        self._odometry_at = now
        self._read(1e-6 * message.time_usec, now, p, q, v, rates, in_body=child in BODIES)

    def _ignore(self, what: str) -> None:
        """Count a message that cannot be used, and note its kind once."""
        self.ignored += 1
        if what not in self.notes and len(self.notes) < MOST_NOTES:
            self.notes.append(what)

    def _attitude_quaternion(self, message: Any, now: float) -> None:
        self._attitude = message

    def _local_position(self, message: Any, now: float) -> None:
        """Combine position and attitude messages into a state if the autopilot does not send ODOMETRY."""
        attitude = self._attitude
        if now - self._odometry_at < ODOMETRY_TIMEOUT_S or attitude is None:
            return
        if abs(message.time_boot_ms - attitude.time_boot_ms) <= 1e3 * PAIRING_S:
            q = np.array([attitude.q1, attitude.q2, attitude.q3, attitude.q4])
            rates = np.array([attitude.rollspeed, attitude.pitchspeed, attitude.yawspeed])
            p, v = np.array([message.x, message.y, message.z]), np.array([message.vx, message.vy, message.vz])
            self._read(1e-3 * message.time_boot_ms, now, p, q, v, rates, in_body=False)

    def _read(
        self, remote: float, now: float, p: np.ndarray, q: np.ndarray, v: np.ndarray, rates: np.ndarray, *,
        in_body: bool
    ) -> None:  # fmt: skip
        if not np.isfinite(np.concatenate([p, q, v, rates])).all() or not 0.5 < q @ q < 2.0:
            self.ignored += 1
            return
        R = frames.attitude_of(q)
        here = self._clock.here(remote)
        stamp = now if here is None else min(here, now)
        if self.reading is not None and stamp < self.reading.stamp and now - stamp < ODOMETRY_TIMEOUT_S:
            return  # it arrived out of order
        velocity = R @ frames.turn_body(v) if in_body else frames.turn_world(v)
        self.reading = Reading(stamp, frames.turn_world(p), R, velocity, frames.turn_body(rates))

    def _attitude_target(self, message: Any, now: float) -> None:
        if math.isfinite(message.thrust):
            self.thrusts.append(float(message.thrust))

    def _text(self, message: Any, now: float) -> None:
        self.texts.append(str(message.text))

    def _hil_state(self, message: Any, now: float) -> None:
        """Read the true state from PX4's own simulator, on a plane that touches the earth at the first position."""
        q = np.array(message.attitude_quaternion)
        if not np.isfinite(q).all() or not 0.5 < q @ q < 2.0:
            self.ignored += 1
            return
        here = (1e-7 * message.lat, 1e-7 * message.lon, 1e-3 * message.alt)
        self._origin = self._origin or here
        per_degree = math.radians(1.0) * 6_371_000.0
        north, east = ((here[i] - self._origin[i]) * per_degree for i in (0, 1))
        p = np.array([east * math.cos(math.radians(self._origin[0])), north, here[2] - self._origin[2]])
        v = frames.turn_world(1e-2 * np.array([message.vx, message.vy, message.vz]))
        rates = frames.turn_body(np.array([message.rollspeed, message.pitchspeed, message.yawspeed]))
        self.truth = Reading(now, p, frames.attitude_of(q), v, rates)
