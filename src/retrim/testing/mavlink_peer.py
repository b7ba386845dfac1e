"""Simulate an autopilot with MAVLink and the plant ``bem``, for tests and trials of a link.

``python -m retrim.testing.mavlink_peer --disturbance large`` runs until Ctrl-C. The peer implements only the part of
PX4 that :mod:`retrim` needs: arming, offboard mode, both kinds of setpoints, landing, and the failsafe for missing
setpoints.
"""

import argparse
import math
import socket
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ..config.scenario import Scenario
from ..errors import exit_on_error
from ..plants.bridges import frames
from ..plants.extras import import_extra
from .peer_vehicle import GROUND, PeerVehicle, fly_until_interrupt, port

OFFBOARD, HOLD, LAND = (6, 0), (4, 3), (4, 6)
FAILSAFE_S = 1.0  # [s]: time without a setpoint until the failsafe
QUADROTOR, PX4, ACTIVE = 2, 12, 4


class MavlinkPeer:
    """An autopilot and its vehicle; :meth:`step` advances both by 0.01 s."""

    def __init__(self, scenario: Scenario, *, port: int = 14540) -> None:
        """Build a vehicle on the ground at the origin, with the nose to the north.

        Args:
            scenario: Plant, vehicle and disturbance.
            port: Local port to which the peer sends.
        """
        self._dialect: Any = import_extra("pymavlink.dialects.v20.common", "mavlink", package="pymavlink")
        self._out = self._dialect.MAVLink(None, srcSystem=1, srcComponent=1)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.setblocking(False)
        self._to = ("127.0.0.1", port)
        self.vehicle = PeerVehicle(scenario, heading=math.pi / 2)
        self.mode, self.armed = HOLD, False
        self.cut = False
        """Whether the link is cut in both directions."""
        self._rates: np.ndarray | None = None
        self._place, self._yaw = np.zeros(3), math.pi / 2
        self._last_command_time, self._tick, self._thrust = -math.inf, 0, 0.0
        self.failsafes = 0
        """Number of times that setpoints have stopped arriving in offboard mode."""
        self._takes: dict[str, Callable[[Any], None]] = {
            "SET_ATTITUDE_TARGET": self._take_rates, "SET_POSITION_TARGET_LOCAL_NED": self._take_place,
            "COMMAND_LONG": self._take_command, "TIMESYNC": self._answer_time,
        }  # fmt: skip

    def step(self) -> None:
        """Read messages, advance by a tick, and send the state."""
        self._read()
        vehicle = self.vehicle
        if vehicle.flies:
            u = self._command()
            self._thrust = float(u[0]) / vehicle.thrust_max
            vehicle.step(u)
            if vehicle.p[2] < GROUND and self.mode == LAND:
                vehicle.flies = self.armed = False
        elif self.armed:
            vehicle.lift_off()
        self._tick += 1
        self._say()

    @property
    def by_rates(self) -> bool:
        """Whether the vehicle flies with externally commanded thrust and body rates."""
        return self.vehicle.flies and self.mode == OFFBOARD and self._rates is not None

    def close(self) -> None:
        """Release the port."""
        self.vehicle.close()
        self._socket.close()

    def _command(self) -> np.ndarray:
        """Return the command that acts on the vehicle: the setpoint, or the output of the autopilot's controller."""
        stale = time.monotonic() - self._last_command_time > FAILSAFE_S
        if self.mode == OFFBOARD and stale:
            self.mode, self.failsafes, self._place, self._rates = HOLD, self.failsafes + 1, self.vehicle.p.copy(), None
            self.vehicle.forget()
        if self.mode == OFFBOARD and self._rates is not None:
            return self._rates
        if self.mode == LAND:
            self._place = np.array([*self._place[:2], max(self.vehicle.p[2] - 0.3, -0.5)])
        return self.vehicle.towards(self._place, self._yaw)

    def _read(self) -> None:
        while True:
            try:
                data = self._socket.recv(65_535)
            except OSError:
                return
            if self.cut:
                continue
            parser = self._dialect.MAVLink(None)
            parser.robust_parsing = True
            for message in parser.parse_buffer(data) or []:
                take = self._takes.get(message.get_type())
                if take is not None:
                    take(message)

    def _take_rates(self, m: Any) -> None:
        omega = frames.turn_body(np.array([m.body_roll_rate, m.body_pitch_rate, m.body_yaw_rate]))
        self._setpoint(np.concatenate([[m.thrust * self.vehicle.thrust_max], omega]))

    def _take_place(self, m: Any) -> None:
        self._place, self._yaw = frames.turn_world(np.array([m.x, m.y, m.z])), frames.turn_heading(m.yaw)
        self._setpoint(None)

    def _setpoint(self, rates: np.ndarray | None) -> None:
        self._rates, self._last_command_time = rates, time.monotonic()
        if self.failsafes and self.mode == HOLD and self.armed:
            self.mode = OFFBOARD  # PX4 also returns to offboard mode automatically

    def _take_command(self, m: Any) -> None:
        fresh = time.monotonic() - self._last_command_time < FAILSAFE_S
        if m.command == 176 and (int(m.param2), int(m.param3)) in (OFFBOARD, LAND) and (m.param2 != 6 or fresh):
            self.mode = (int(m.param2), int(m.param3))
            self._place = self._place if self.mode == OFFBOARD else self.vehicle.p.copy()
        if m.command == 400:
            self.armed = bool(m.param1)
        self._send(self._out.command_ack_encode(m.command, 0))

    def _answer_time(self, m: Any) -> None:
        if m.tc1 == 0:
            self._send(self._out.timesync_encode(int(self._now() * 1e9), m.ts1))

    def _now(self) -> float:
        """Return the time of the autopilot's clock, which has a different origin and runs too slowly."""
        return 0.99 * (time.monotonic() % 1e5)

    def _say(self) -> None:
        out, us = self._out, int(self._now() * 1e6)
        x = self.vehicle
        place, velocity = frames.turn_world(x.p), frames.turn_world(x.v)
        self._send(out.odometry_encode(
            us, 1, 1, *place, frames.quaternion_of(x.R).tolist(), *velocity, *frames.turn_body(x.omega),
            [math.nan] * 21, [math.nan] * 21
        ))  # fmt: skip
        if self._tick % 4 == 0:
            self._send(out.attitude_target_encode(us // 1000, 0, [1.0, 0.0, 0.0, 0.0], 0, 0, 0, self._thrust))
        if self._tick % 20 == 0:
            custom = self.mode[0] << 16 | self.mode[1] << 24
            self._send(out.heartbeat_encode(QUADROTOR, PX4, 0x80 if self.armed else 0, custom, ACTIVE))
            self._send(out.sys_status_encode(0, 0, 0x10000000, 0, 12_000, 0, -1, 0, 0, 0, 0, 0, 0))

    def _send(self, message: Any) -> None:
        data = message.pack(self._out)
        if not self.cut:
            try:
                self._socket.sendto(data, self._to)
            except OSError:  # the receiver is not listening yet, or no longer listens
                return


@exit_on_error
def main(words: Sequence[str] | None = None) -> None:
    """Fly until Ctrl-C."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--disturbance", default="none", help="as for `retrim fly`")
    parser.add_argument("--plant", default="bem", help="as for `retrim fly`")
    parser.add_argument("--port", type=port, default=14540, help="where it sends to, on this machine")
    parser.add_argument(
        "--cut", type=float, nargs=2, help="seconds in offboard mode by rates until the link is cut, and for how long"
    )
    parser.add_argument("--takes-over", type=float, default=math.inf, help="seconds by rates until a pilot takes over")
    options = parser.parse_args(words)
    peer = MavlinkPeer(Scenario(options.disturbance, options.plant), port=options.port)
    engage_time = math.inf

    def step() -> None:
        nonlocal engage_time
        now = time.monotonic()
        if peer.by_rates:
            engage_time = min(engage_time, now)
        if peer.by_rates and now - engage_time > options.takes_over:
            peer.mode = HOLD
        peer.cut = options.cut is not None and options.cut[0] <= now - engage_time < sum(options.cut)
        peer.step()

    fly_until_interrupt(step, f"it sends to udp:127.0.0.1:{options.port}")
    peer.close()


if __name__ == "__main__":
    main()
