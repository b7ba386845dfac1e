"""Simulate a vehicle with an autopilot's position controller, for the peers of all protocols."""

import argparse
import math
import os
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..config.scenario import Scenario
from ..onboard.guard import GeometricHover, Limits
from ..onboard.realtime import be_punctual, sleep_until
from ..physics.so3 import rotz
from ..physics.state import STANDARD_GRAVITY, Command, State
from ..plants.bridges import frames
from ..plants.plant import as_numpy

DT = 0.01  # [s]: tick
GROUND = 0.05  # [m]: height below which a vehicle touches the ground
ATTITUDE_IGNORED = 128  # in the type_mask of an AttitudeTarget


def port(text: str) -> int:
    """Return the number of a port on the command line of a peer."""
    if not (text.isdecimal() and 1 <= int(text) <= 65535):
        raise argparse.ArgumentTypeError(f"a port must be 1 to 65535, got {text}")
    return int(text)


class PeerVehicle:
    """A vehicle that stands on the ground at the origin until it lifts off; :meth:`step` advances time by 0.01 s."""

    def __init__(self, scenario: Scenario, *, heading: float) -> None:
        """Build a vehicle.

        Args:
            scenario: Plant, vehicle and disturbance.
            heading: Heading of the nose, counter-clockwise from east [rad].
        """
        vehicle = scenario.make_vehicle("small")
        self._plant = scenario.make("small", dt=DT, seed=0)
        self.x, self.omega = _standing(0.0, 0.0, heading), np.zeros(3)
        """State [p, R, v] and body rates."""
        self.flies = False
        low, high = (as_numpy(u).astype(float) for u in (vehicle.command_min, vehicle.command_max))
        fence = np.full(3, 1e3)
        self._hover = GeometricHover(Limits(-fence, fence, low, high), DT)
        self.thrust_max = float(vehicle.thrust_max / vehicle.mass)
        """Maximum total thrust per mass [m/s^2]."""
        self._place(np.zeros(3))
        self._step_plant(np.array([STANDARD_GRAVITY, 0.0, 0.0, 0.0]))  # compile before the first real step

    @property
    def p(self) -> np.ndarray:
        """Position in the world frame [m]."""
        return self.x[:3]

    @property
    def R(self) -> np.ndarray:
        """Attitude, as the rotation from the body to the world frame."""
        return self.x[3:12].reshape(3, 3)

    @property
    def v(self) -> np.ndarray:
        """Velocity in the world frame [m/s]."""
        return self.x[12:]

    def lift_off(self) -> None:
        """Start flying at the current position."""
        self.flies = True
        self._place(np.array([*self.p[:2], GROUND]))

    def hover(self, place: np.ndarray, v: np.ndarray | None = None) -> None:
        """Put the vehicle in the air, level.

        Args:
            place: Position in the world frame [m].
            v: Velocity in the world frame [m/s]; None for a vehicle at rest.
        """
        self.flies, self.omega = True, np.zeros(3)
        self.x = _standing(place[0], place[1], frames.heading_of(self.R))
        self.x[2], self.x[12:] = place[2], 0.0 if v is None else v
        self.forget()
        self._place(self.p, self.v)

    def step(self, u: np.ndarray) -> None:
        """Apply a command [c, omega] for one tick."""
        x = self._step_plant(u)
        before, after = self.R, np.asarray(x.R, dtype=float)
        rotation = (before.T @ after - after.T @ before) / (2 * DT)
        self.omega = np.array([rotation[2, 1], rotation[0, 2], rotation[1, 0]])
        self.x = np.concatenate([np.asarray(leaf, dtype=float).ravel() for leaf in (x.p, x.R, x.v)])

    def stand(self) -> None:
        """Put the vehicle upright on the ground at the current position."""
        self.flies, self.omega = False, np.zeros(3)
        self.x = _standing(self.p[0], self.p[1], frames.heading_of(self.R))

    def towards(self, place: np.ndarray, yaw: float) -> np.ndarray:
        """Return the command [c, omega] that moves the vehicle to a position [m] and a heading [rad]."""
        u = self._hover.command(self.x, place)
        wrong = yaw - frames.heading_of(self.R)
        u[3] += np.clip(2.0 * math.atan2(math.sin(wrong), math.cos(wrong)), -1.0, 1.0)
        return u

    def by_target(self, target: Any) -> np.ndarray:
        """Return the command [c, omega] of an AttitudeTarget of mavros: body rates, or an attitude."""
        from scipy.spatial.transform import Rotation  # local, because this import takes as long as that of retrim

        c, rate, q = target.thrust * self.thrust_max, target.body_rate, target.orientation
        if target.type_mask & ATTITUDE_IGNORED:
            return np.array([c, rate.x, rate.y, rate.z])
        wrong = self.R.T @ Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
        turn = 0.5 * np.array([wrong[2, 1] - wrong[1, 2], wrong[0, 2] - wrong[2, 0], wrong[1, 0] - wrong[0, 1]])
        return np.concatenate([[c], 6.0 * turn])

    def forget(self) -> None:
        """Reset the position controller's integral, which compensates the disturbance."""
        self._hover.integral[:] = 0.0

    def close(self) -> None:
        """End the simulation."""
        self._plant.stop()

    def _place(self, p: np.ndarray, v: np.ndarray | None = None) -> None:
        v = np.zeros(3) if v is None else v
        self._plant.reset(State(*(jnp.asarray(a, jnp.result_type(float)) for a in (p, self.R, v))))

    def _step_plant(self, u: np.ndarray) -> State:
        dtype = jnp.result_type(float)
        return self._plant.step(Command(jnp.asarray(u[0], dtype), jnp.asarray(u[1:], dtype)))[0].x


def _standing(x: float, y: float, yaw: float) -> np.ndarray:
    """Return the state [p, R, v] of an upright vehicle on the ground."""
    R = np.asarray(rotz(jnp.asarray(yaw, jnp.result_type(float))), dtype=float)
    return np.concatenate([[x, y, 0.0], R.ravel(), np.zeros(3)])


def fly_until_interrupt(step: Callable[[], None], address: str, period: float = DT) -> None:
    """Call a step function periodically until Ctrl-C.

    Args:
        step: Function to call.
        address: Description of the peer's address, for the printed message.
        period: Time between two calls [s].
    """
    jax.config.update("jax_cpu_enable_async_dispatch", False)
    print(f"{address}; Ctrl-C ends it", flush=True)
    be_punctual(25, os.sched_getaffinity(0))
    began, tick = time.monotonic(), 0
    try:
        while True:
            step()
            tick = max(tick + 1, int((time.monotonic() - began) / period))
            sleep_until(began + tick * period)
    except KeyboardInterrupt:
        return
