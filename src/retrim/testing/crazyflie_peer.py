"""Simulate a Crazyflie with CRTP and the plant ``bem``, for tests and trials of a link.

``python -m retrim.testing.crazyflie_peer --disturbance large`` runs until Ctrl-C. The peer implements only the part of
the firmware that :mod:`retrim` needs (versions, the log, arming, the firmware's commander, the manual setpoint, and the
reaction to missing setpoints), and the initial requests of a client. The vehicle is one of retrim's; only the protocol
is that of a Crazyflie.
"""

import argparse
import math
import socket
import struct
import time
from collections.abc import Sequence

import numpy as np

from ..config.scenario import Scenario
from ..errors import MessageError, exit_on_error
from ..plants.bridges import crtp
from ..plants.bridges.crtp import Packet
from .peer_vehicle import GROUND, PeerVehicle, fly_until_interrupt, port

VERSION = 12  # protocol version
LEVELS_S, STOP_S = 0.5, 2.0  # [s]: time without a setpoint until the vehicle levels, and until the motors stop
READY_S = 0.5  # [s]: time from the start until arming is possible
FULL = 65_535.0  # full thrust
VARIABLES = {**crtp.STATUS_LOG, "stateEstimate.x": "f", "stateEstimate.y": "f", **crtp.STATE_LOG}
UNKNOWN_ENTRY = 2  # error code for an unknown block or variable


class CrazyfliePeer:
    """A simulated Crazyflie; :meth:`step` advances the simulation by 0.01 s."""

    def __init__(self, scenario: Scenario, *, port: int = 19850) -> None:
        """Build a vehicle on the ground at the origin, with the nose along x.

        Args:
            scenario: Plant, vehicle and disturbance.
            port: Local port on which the peer listens.
        """
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", port))
        self._socket.setblocking(False)
        self._client: tuple[str, int] | None = None
        self.vehicle = PeerVehicle(scenario, heading=0.0)
        self._began = time.monotonic()
        self.armed = self.locked = self.cut = False
        """Whether the vehicle is armed, whether its supervisor has locked it, and whether the link is cut both ways."""
        self._place: np.ndarray | None = None
        self._yaw = 0.0
        self._lands = False
        self._setpoint: np.ndarray | None = None
        self._last_command_time = -math.inf
        self._thrust = 0.0
        self._blocks: dict[int, list[str]] = {}
        self._periods: dict[int, int] = {}
        self._tick = 0

    @property
    def by_rates(self) -> bool:
        """Whether the vehicle flies with externally commanded thrust and body rates."""
        return self.vehicle.flies and self._setpoint is not None

    def step(self) -> None:
        """Read packets, advance by a tick, and send the log."""
        self._read()
        vehicle, u = self.vehicle, self._command()
        self._thrust = 0.0 if u is None else float(u[0]) / vehicle.thrust_max * FULL
        if vehicle.flies:
            vehicle.step(np.zeros(4) if u is None else u)
            if vehicle.p[2] < GROUND and (self._lands or u is None):
                self.locked = self.locked or (u is None and float(np.linalg.norm(vehicle.v)) > 1.0)
                vehicle.stand()
                self._place, self._lands = None, False
        elif u is not None and self.armed:
            vehicle.lift_off()
        self._tick += 1
        for block, every in self._periods.items():
            if self._tick % every == 0:
                values = b"".join(self._value(name) for name in self._blocks[block])
                ms = round(1e3 * (time.monotonic() - self._began)) % (1 << 24)
                self._send(Packet(crtp.LOG, crtp.DATA, bytes([block]) + ms.to_bytes(3, "little") + values))

    def close(self) -> None:
        """Release the port."""
        self.vehicle.close()
        self._socket.close()

    def _command(self) -> np.ndarray | None:
        """Return the command that acts on the vehicle; None if the motors are off."""
        since = time.monotonic() - self._last_command_time
        if not self.armed or self.locked:
            return None
        if self._setpoint is not None:
            if since < LEVELS_S:
                return self._setpoint
            if since > STOP_S:
                return None
            upright = np.array([0.0, 0.0, 1.0])
            level = 6.0 * (self.vehicle.R.T @ np.cross(self.vehicle.R[:, 2], upright))
            return np.array([self._setpoint[0], level[0], level[1], 0.0])
        if self._place is None:
            return None
        if self._lands:
            self._place = np.array([*self._place[:2], max(self.vehicle.p[2] - 0.3, -0.5)])
        return self.vehicle.towards(self._place, self._yaw)

    def _info(self) -> int:
        flies = self.vehicle.flies
        bits = crtp.CAN_ARM * (not self.armed and time.monotonic() - self._began > READY_S)
        return int(bits | (crtp.ARMED | crtp.CAN_FLY) * self.armed | crtp.FLYING * flies | crtp.LOCKED * self.locked)

    def _value(self, name: str) -> bytes:
        x = self.vehicle
        group, _, of = name.partition(".")
        if group == "stateEstimateZ":
            offset = struct.calcsize("<" + "".join(list(crtp.STATE_LOG.values())[: list(crtp.STATE_LOG).index(name)]))
            kind = struct.calcsize("<" + crtp.STATE_LOG[name])
            return crtp.state_values(x.p, x.R, x.v, x.omega)[offset : offset + kind]
        variables = {"thrust": self._thrust, "info": self._info(), "vbat": 3.9, "x": float(x.p[0]), "y": float(x.p[1])}
        return struct.pack("<" + VARIABLES[name], variables[of])

    def _read(self) -> None:
        while True:
            try:
                data, sender = self._socket.recvfrom(2048)
            except OSError:
                return
            if self.cut:
                continue
            self._client = sender
            try:
                self._take(crtp.unpack(data))
            except (MessageError, struct.error, IndexError, ValueError):
                continue

    def _take(self, packet: Packet) -> None:
        port, channel, body = packet
        if (port, channel) in ((crtp.LINK, 0), (crtp.LINK, 3)):  # an echo; a scan for vehicles
            self._send(packet)
        elif (port, channel) == (crtp.LINK, 1):
            self._send(packet._replace(body=b"Bitcraze Crazyflie".ljust(30, b"\0")))
        elif (port, channel) == (crtp.PLATFORM, 1) and body[:1] == b"\0":
            self._send(packet._replace(body=bytes([0, VERSION])))
        elif (port, channel) == (crtp.SUPERVISOR, 1) and body[0] == 1:
            self.armed = bool(body[1]) and not self.locked and time.monotonic() - self._began > READY_S
            self._send(packet._replace(body=bytes([0x81, self.armed == bool(body[1]), self.armed])))
        elif (port, channel) == (crtp.SUPERVISOR, 0) and body[0] == 0x0C:
            self._send(packet._replace(body=b"\x8c" + struct.pack("<H", self._info())))
        elif (port, channel) in ((crtp.PARAMETERS, 0), (crtp.MEMORY, 0)):
            self._send(packet._replace(body=body[:1] + bytes(6)))  # the peer has no parameters and no memories
        elif port == crtp.LOG:
            self._log(packet)
        elif (port, channel) == (crtp.SETPOINT, 0) and body[0] == crtp.MANUAL:
            self._manual(body)
        elif (port, channel) == (crtp.SETPOINT, 1) and body[0] == crtp.RELAX:
            self._setpoint = None
            self._place = self.vehicle.p.copy() if self.vehicle.flies else None
        elif port == crtp.HIGH_LEVEL:
            self._plan(body)
            self._send(packet._replace(body=body[:3].ljust(3, b"\0") + b"\0"))

    def _manual(self, body: bytes) -> None:
        _, roll, pitch, yaw, thrust, rate = struct.unpack("<BfffHB", body)
        if rate == 1:
            c = thrust / FULL * self.vehicle.thrust_max
            self._setpoint = np.array([c, *np.radians([roll, -pitch, yaw])])
            self._last_command_time = time.monotonic()

    def _plan(self, body: bytes) -> None:
        kind, x = body[0], self.vehicle
        if kind == crtp.TAKE_OFF and not x.flies:
            height, self._yaw = struct.unpack("<ff", body[2:10])
            self._place, self._setpoint, self._lands = np.array([*x.p[:2], height]), None, False
        elif kind == crtp.GO_TO_LINEAR and x.flies:
            *place, self._yaw, _ = struct.unpack("<5f", body[4:24])
            self._place = np.array(place)
        elif kind == crtp.LAND and x.flies:
            self._place, self._lands = x.p.copy(), True
        elif kind == crtp.HL_STOP:
            self._place, self._lands = None, False

    def _log(self, packet: Packet) -> None:
        _, channel, body = packet
        if channel == crtp.TOC and body[0] == crtp.INFO:
            self._send(packet._replace(body=struct.pack("<BHIBB", crtp.INFO, len(VARIABLES), 0x12345678, 16, 128)))
        elif channel == crtp.TOC and body[0] == crtp.ITEM:
            (number,) = struct.unpack("<H", body[1:3])
            name, kind = list(VARIABLES.items())[number]
            reply = body[:3] + bytes([crtp.LOG_TYPES[kind]]) + name.encode().replace(b".", b"\0") + b"\0"
            self._send(packet._replace(body=reply))
        elif channel == crtp.CONTROL:
            self._send(packet._replace(body=body[:2].ljust(2, b"\0") + bytes([self._execute(body)])))

    def _execute(self, body: bytes) -> int:
        """Execute a request about a log block; return the error code, which is 0 on success."""
        if body[0] == crtp.RESET:
            self._blocks, self._periods = {}, {}
        elif body[0] in (crtp.CREATE, crtp.APPEND):
            whole = 2 + 3 * ((len(body) - 2) // 3)  # the firmware also ignores an incomplete entry
            numbers = [number for _, number in struct.iter_unpack("<BH", body[2:whole])]
            if max(numbers) >= len(VARIABLES) or (body[0] == crtp.APPEND and body[1] not in self._blocks):
                return UNKNOWN_ENTRY
            before = [] if body[0] == crtp.CREATE else self._blocks[body[1]]
            self._blocks[body[1]] = before + [list(VARIABLES)[number] for number in numbers]
        elif body[0] == crtp.START:
            if body[1] not in self._blocks:
                return UNKNOWN_ENTRY
            self._periods[body[1]] = max(1, body[2])
        return 0

    def _send(self, packet: Packet) -> None:
        if not self.cut and self._client is not None:
            try:
                self._socket.sendto(packet.pack(), self._client)
            except OSError:  # the client no longer listens
                return


@exit_on_error
def main(words: Sequence[str] | None = None) -> None:
    """Fly until Ctrl-C."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--disturbance", default="none", help="as for `retrim fly`")
    parser.add_argument("--plant", default="bem", help="as for `retrim fly`")
    parser.add_argument("--port", type=port, default=19850, help="where it listens, on this machine")
    parser.add_argument("--cut", type=float, nargs=2, help="seconds by rates until the link is cut, and for how long")
    options = parser.parse_args(words)
    peer = CrazyfliePeer(Scenario(options.disturbance, options.plant), port=options.port)
    engage_time = math.inf

    def step() -> None:
        nonlocal engage_time
        if peer.by_rates:
            engage_time = min(engage_time, time.monotonic())
        peer.cut = options.cut is not None and options.cut[0] <= time.monotonic() - engage_time < sum(options.cut)
        peer.step()

    fly_until_interrupt(step, f"it listens at udp:127.0.0.1:{options.port}")
    peer.close()


if __name__ == "__main__":
    main()
