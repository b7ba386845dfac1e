"""The guard, which checks the limits of a flight and contains the fallback controller, without learning or a policy."""

from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np

G = 9.81  # [m/s^2]
HOVER = np.array([G, 0.0, 0.0, 0.0])
UP = np.array([0.0, 0.0, 1.0])
DISTURBANCE_TAU = 0.2  # [s]
BLIND_LIMIT_S = 2.0  # [s], after which the motors of a vehicle with an unknown state stop


class Mode(IntEnum):
    """Active controller or state of the flight."""

    POLICY = 0
    HOLD = 1
    """The geometric controller holds the last target position."""
    DESCEND = 2
    """The geometric controller makes the vehicle sink."""
    BLIND = 3
    """The state is unknown; the vehicle levels using its last known attitude and sinks."""
    LANDED = 4
    WATCHDOG = 5
    """The watchdog flies the fallback, because the control process is dead."""
    DROP = 6
    """The motors stop wherever the vehicle is, because its state has been unknown for too long."""


FINAL_MODES = Mode.LANDED, Mode.DROP
"""Modes that end the flight; no command follows."""


@dataclass(frozen=True)
class Limits:
    """Limits of a flight."""

    low: np.ndarray
    """Lower corner of the geofence in the world frame [m]."""
    high: np.ndarray
    """Upper corner of the geofence in the world frame [m]."""
    u_min: np.ndarray
    """Smallest command [c, omega] that the vehicle accepts."""
    u_max: np.ndarray
    """Largest command [c, omega] that the vehicle accepts."""
    floor: float = 0.1
    """Height at which the vehicle counts as landed [m]."""
    tilt: float = 1.4
    """Largest angle between thrust and vertical [rad]."""
    speed: float = 15.0
    """Largest speed [m/s]."""
    state_age: float = 0.1
    """Largest age of the newest measurement [s]."""
    policy_age: float = float("inf")
    """Largest flight time since the newest measurement in the policy's training data [s]."""

    def within(self, u: np.ndarray) -> np.ndarray:
        """Return a command [c, omega] clipped to the vehicle's limits."""
        limited_u: np.ndarray = np.clip(u, self.u_min, self.u_max)
        return limited_u

    def find_violation(self, x: np.ndarray) -> str | None:
        """Return a description of the limit that a state violates; None if the state is within all limits.

        Args:
            x: State: p, R by rows, v.
        """
        p, upright, v = x[:3], x[11], x[12:15]
        if not np.isfinite(x).all():
            return "the state is not finite"
        if (p < self.low).any() or (p > self.high).any():
            return f"geofence: at {p.round(2).tolist()} m, allowed {self.low.tolist()} to {self.high.tolist()}"
        if upright < np.cos(self.tilt):
            return f"tilt: {np.arccos(np.clip(upright, -1.0, 1.0)):.2f} rad, allowed {self.tilt:g}"
        speed = float(np.sqrt(v @ v))
        return f"speed: {speed:.1f} m/s, allowed {self.speed:g}" if speed > self.speed else None


@dataclass
class GeometricHover:
    """Holds a position using thrust and body-rate commands, with integral action.

    The controller is that of Lee et al. (2010), with the attitude error as a rotation vector.
    """

    limits: Limits
    dt: float
    integral: np.ndarray = field(default_factory=lambda: np.zeros(3))
    disturbance: np.ndarray = field(default_factory=lambda: np.zeros(3))
    """Low-pass-filtered acceleration from external disturbances in the world frame [m/s^2]."""

    def feel(self, before: np.ndarray, after: np.ndarray, u: np.ndarray) -> None:
        """Update the disturbance estimate with the acceleration during one tick, minus thrust and gravity.

        Args:
            before: State at the start of the tick: p, R by rows, v.
            after: State at the end of the tick.
            u: Command that acted during the tick.
        """
        a = (after[12:15] - before[12:15]) / self.dt - u[0] * before[3:12].reshape(3, 3)[:, 2] + G * UP
        if np.isfinite(a).all():
            self.disturbance = np.clip(
                self.disturbance + min(1.0, self.dt / DISTURBANCE_TAU) * (a - self.disturbance), -5.0, 5.0
            )

    def command(self, x: np.ndarray, target: np.ndarray, velocity: np.ndarray | None = None) -> np.ndarray:
        """Return the command [c, omega].

        Args:
            x: State: p, R by rows, v.
            target: Target position, world [m].
            velocity: Velocity of the target, world [m/s]; None if the target does not move.
        """
        p, R, v = x[:3], x[3:12].reshape(3, 3), x[12:15]
        error = np.clip(target - p, -1.0, 1.0)
        self.integral = np.clip(self.integral + self.dt * error, -2.0, 2.0)
        a = 4.0 * error + 2.0 * self.integral + 3.5 * ((0.0 if velocity is None else velocity) - v) - self.disturbance
        a[:2] *= min(1.0, 6.0 / (np.hypot(a[0], a[1]) + 1e-9))
        force = np.clip(a, -6.0, 6.0) + G * UP
        along = force / np.sqrt(force @ force)
        return self.limits.within(np.concatenate([[force @ R[:, 2]], 8.0 * turn(R, along)]))


def turn(R: np.ndarray, along: np.ndarray) -> np.ndarray:
    """Return the smallest rotation vector in the body frame that points the thrust along a direction [rad]."""
    d = R.T @ along
    sine = np.hypot(d[0], d[1])
    angle = np.arctan2(sine, d[2])
    if sine < 1e-9:  # upright, or upside down, where all directions of rotation are equally short
        return np.zeros(3) if d[2] > 0 else np.array([angle, 0.0, 0.0])
    rotation: np.ndarray = angle / sine * np.array([-d[1], d[0], 0.0])
    return rotation


@dataclass
class Fallback:
    """Fallback controller for when the policy must not fly: it holds a position, sinks and stops the motors."""

    hover: GeometricHover
    hold_s: float = 2.0
    sink: float = 0.5
    """Sink rate [m/s]."""
    still_s: float = 0.0
    """Time during the descent for which the vehicle has not moved [s]; a vehicle at rest stands on something."""
    sinking_s: float = 0.0
    since: float = 0.0
    """Time for which the fallback has been active [s]."""
    blind_s: float = 0.0
    place: np.ndarray | None = None
    """Position that the vehicle holds, and from which its descent starts."""

    def rest(self) -> None:
        """Reset while a different controller is active; the next step begins a new sequence."""
        self.since, self.blind_s, self.sinking_s, self.still_s, self.place = 0.0, 0.0, 0.0, 0.0, None
        self.hover.integral[:] = 0.0

    def step(self, x: np.ndarray, fresh: bool, target: np.ndarray, *, land: bool) -> tuple[np.ndarray, Mode]:
        """Return the command [c, omega] for the next tick, and the mode.

        Args:
            x: Last known state: p, R by rows, v.
            fresh: Whether the state is recent.
            target: Current target position, world [m]; the target of the first call is held.
            land: Whether to sink immediately.
        """
        if self.place is None:
            self.place = target.copy()
        self.since += self.hover.dt
        self.blind_s = 0.0 if fresh else self.blind_s + self.hover.dt
        if self.blind_s > BLIND_LIMIT_S:
            return np.zeros(4), Mode.DROP
        if self._down(x, fresh):
            return np.zeros(4), Mode.LANDED
        if not fresh:
            # Sink slowly. Level for a quarter of a second using the last known attitude; then command zero rates.
            rates = 4.0 * turn(x[3:12].reshape(3, 3), UP) if self.blind_s <= 0.25 else np.zeros(3)
            return self.hover.limits.within(np.concatenate([[0.95 * G], rates])), Mode.BLIND
        if land or self.since > self.hold_s:
            self.sinking_s += self.hover.dt
            self.place[2] = min(self.place[2], x[2] + 0.3) - self.hover.dt * self.sink
            return self.hover.command(x, self.place, -self.sink * UP), Mode.DESCEND
        return self.hover.command(x, self.place), Mode.HOLD

    def _down(self, x: np.ndarray, fresh: bool) -> bool:
        """Return whether a sinking vehicle has reached the floor or stands on something."""
        if not fresh or self.sinking_s < 0.2:
            return False
        moving = float(np.abs(x[12:15]).max()) > 0.1
        self.still_s = 0.0 if moving else self.still_s + self.hover.dt
        return bool(x[2] <= self.hover.limits.floor) or self.still_s > 2.0
