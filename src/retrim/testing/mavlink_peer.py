"""A peer that speaks MAVLink as PX4 does and flies the plant ``bem``: for tests, and to try a link without a vehicle.

``python -m retrim.testing.mavlink_peer --disturbance large`` flies until Ctrl-C. It knows what :mod:`retrim` needs of
PX4 (arming, offboard mode, both kinds of setpoints, landing, the failsafe where setpoints stop) and nothing else.
"""

import argparse
import math
import os
import socket
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..config.scenario import Scenario
from ..onboard.guard import GeometricHover, Limits
from ..onboard.realtime import be_punctual, sleep_until
from ..physics.state import STANDARD_GRAVITY, Command, State
from ..plants.bridges import frames
from ..plants.extras import import_extra
from ..plants.plant import as_numpy

DT = 0.01  # [s]
OFFBOARD, HOLD, LAND = (6, 0), (4, 3), (4, 6)
FAILSAFE_S = 1.0  # [s] without a setpoint
QUADROTOR, PX4, ACTIVE = 2, 12, 4
GROUND = 0.05  # [m]


class MavlinkPeer:
    """An autopilot and its vehicle. :meth:`step` is a hundredth of a second of both."""

    def __init__(self, scenario: Scenario, *, port: int = 14540, seed: int = 0) -> None:
        """Build one that stands at the origin, its nose to the north.

        Args:
            scenario: Plant, vehicle and what disturbs the flight.
            port: Where it sends to, on this machine.
            seed: Of the disturbance.
        """
        self._dialect: Any = import_extra("pymavlink.dialects.v20.common", "mavlink", package="pymavlink")
        self._out = self._dialect.MAVLink(None, srcSystem=1, srcComponent=1)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.setblocking(False)
        self._to = ("127.0.0.1", port)
        self._vehicle = scenario.make_vehicle("small")
        self._plant = scenario.make("small", dt=DT, seed=seed)
        self.x, self._omega = self._stand(np.zeros(3)), np.zeros(3)
        low, high = (as_numpy(u).astype(float) for u in (self._vehicle.command_min, self._vehicle.command_max))
        fence = np.full(3, 1e3)
        self._hover = GeometricHover(Limits(-fence, fence, low, high), DT)
        self._per_thrust = float(self._vehicle.thrust_max / self._vehicle.mass)
        self.mode, self.armed, self.flies = HOLD, False, False
        self.cut = False
        """Nothing comes and nothing goes."""
        self._rates: np.ndarray | None = None
        self._place, self._yaw = np.zeros(3), math.pi / 2
        self._told, self._tick, self._thrust = -math.inf, 0, 0.0
        self.failsafes = 0
        """How often setpoints stopped in offboard mode."""
        self._takes: dict[str, Callable[[Any], None]] = {
            "SET_ATTITUDE_TARGET": self._take_rates, "SET_POSITION_TARGET_LOCAL_NED": self._take_place,
            "COMMAND_LONG": self._take_command, "TIMESYNC": self._answer_time,
        }  # fmt: skip
        self._step_plant(np.array([STANDARD_GRAVITY, 0.0, 0.0, 0.0]))  # compiled before somebody waits for it

    def step(self) -> None:
        """Read what came, fly for a tick, and say how it went."""
        self._read()
        if self.flies:
            u = self._commanded()
            self._thrust = float(u[0]) / self._per_thrust
            self._step_plant(u)
            if self.x[2] < GROUND and self.mode == LAND:
                self.flies = self.armed = False
        elif self.armed:
            self.flies = True
            self._reset(np.array([*self.x[:2], GROUND]), self.x[3:12].reshape(3, 3))
        self._tick += 1
        self._say()

    @property
    def by_rates(self) -> bool:
        """Whether it flies thrust and body rates that somebody else commands."""
        return self.flies and self.mode == OFFBOARD and self._rates is not None

    def close(self) -> None:
        """Give the port back."""
        self._plant.stop()
        self._socket.close()

    def _stand(self, p: np.ndarray) -> np.ndarray:
        north = frames.attitude_of(np.array([1.0, 0.0, 0.0, 0.0]))
        self._reset(p, north)
        return np.concatenate([p, north.ravel(), np.zeros(3)])

    def _reset(self, p: np.ndarray, R: np.ndarray) -> None:
        self._plant.reset(State(*(jnp.asarray(a, jnp.result_type(float)) for a in (p, R, np.zeros(3)))))

    def _step_plant(self, u: np.ndarray) -> None:
        dtype = jnp.result_type(float)
        measurement, _ = self._plant.step(Command(jnp.asarray(u[0], dtype), jnp.asarray(u[1:], dtype)))
        x = measurement.x
        if self.flies:
            before, after = self.x[3:12].reshape(3, 3), np.asarray(x.R, dtype=float)
            turned = (before.T @ after - after.T @ before) / (2 * DT)
            self._omega = np.array([turned[2, 1], turned[0, 2], turned[1, 0]])
            self.x = np.concatenate([np.asarray(leaf, dtype=float).ravel() for leaf in (x.p, x.R, x.v)])

    def _commanded(self) -> np.ndarray:
        """Return what flies: the setpoint, or the autopilot itself."""
        stale = time.monotonic() - self._told > FAILSAFE_S
        if self.mode == OFFBOARD and stale:
            self.mode, self.failsafes, self._place, self._rates = HOLD, self.failsafes + 1, self.x[:3].copy(), None
            self._hover.integral[:] = 0.0
        if self.mode == OFFBOARD and self._rates is not None:
            return self._rates
        if self.mode == LAND:
            self._place = np.array([*self._place[:2], max(self.x[2] - 0.3, -0.5)])
        u = self._hover.command(self.x, self._place)
        wrong = self._yaw - frames.heading_of(self.x[3:12].reshape(3, 3))
        u[3] += np.clip(2.0 * math.atan2(math.sin(wrong), math.cos(wrong)), -1.0, 1.0)
        return u

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
        omega = frames.turned_body(np.array([m.body_roll_rate, m.body_pitch_rate, m.body_yaw_rate]))
        self._setpoint(np.concatenate([[m.thrust * self._per_thrust], omega]))

    def _take_place(self, m: Any) -> None:
        self._place, self._yaw = frames.turned_world(np.array([m.x, m.y, m.z])), frames.turned_heading(m.yaw)
        self._setpoint(None)

    def _setpoint(self, rates: np.ndarray | None) -> None:
        self._rates, self._told = rates, time.monotonic()
        if self.failsafes and self.mode == HOLD and self.armed:
            self.mode = OFFBOARD  # as PX4 does, by itself

    def _take_command(self, m: Any) -> None:
        fresh = time.monotonic() - self._told < FAILSAFE_S
        if m.command == 176 and (int(m.param2), int(m.param3)) in (OFFBOARD, LAND) and (m.param2 != 6 or fresh):
            self.mode = (int(m.param2), int(m.param3))
            self._place = self._place if self.mode == OFFBOARD else self.x[:3].copy()
        if m.command == 400:
            self.armed = bool(m.param1)
        self._send(self._out.command_ack_encode(m.command, 0))

    def _answer_time(self, m: Any) -> None:
        if m.tc1 == 0:
            self._send(self._out.timesync_encode(int(self._now() * 1e9), m.ts1))

    def _now(self) -> float:
        """Its own clock: it began when it was built, and is slow."""
        return 0.99 * (time.monotonic() % 1e5)

    def _say(self) -> None:
        out, us = self._out, int(self._now() * 1e6)
        R = self.x[3:12].reshape(3, 3)
        place, velocity = frames.turned_world(self.x[:3]), frames.turned_world(self.x[12:])
        self._send(out.odometry_encode(
            us, 1, 1, *place, frames.quaternion_of(R).tolist(), *velocity, *frames.turned_body(self._omega),
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
            except OSError:  # nobody listens yet, or any more
                return


def main() -> None:
    """Fly until Ctrl-C."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--disturbance", default="none", help="as for `retrim fly`")
    parser.add_argument("--plant", default="bem", help="as for `retrim fly`")
    parser.add_argument("--port", type=int, default=14540, help="where it sends to, on this machine")
    parser.add_argument(
        "--cut", type=float, nargs=2, help="seconds in offboard mode by rates until the link is cut, and for how long"
    )
    parser.add_argument("--takes-over", type=float, default=math.inf, help="seconds by rates until a pilot takes over")
    chosen = parser.parse_args()
    jax.config.update("jax_cpu_enable_async_dispatch", False)
    peer = MavlinkPeer(Scenario(chosen.disturbance, chosen.plant), port=chosen.port)
    print(f"it sends to udp:127.0.0.1:{chosen.port}; Ctrl-C ends it", flush=True)
    be_punctual(25, os.sched_getaffinity(0))
    began, tick, engaged = time.monotonic(), 0, math.inf
    try:
        while True:
            now = time.monotonic()
            if peer.by_rates:
                engaged = min(engaged, now)
            if peer.by_rates and now - engaged > chosen.takes_over:
                peer.mode = HOLD
            peer.cut = chosen.cut is not None and chosen.cut[0] <= now - engaged < sum(chosen.cut)
            peer.step()
            tick = max(tick + 1, int((time.monotonic() - began) / DT))
            sleep_until(began + tick * DT)
    except KeyboardInterrupt:
        peer.close()


if __name__ == "__main__":
    main()
