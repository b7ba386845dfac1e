"""The guard: limits of a flight, and what flies when one is broken. It needs no learning and no policy."""

from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np

G = 9.81  # [m/s^2]
HOVER = np.array([G, 0.0, 0.0, 0.0])
UP = np.array([0.0, 0.0, 1.0])
FELT_TAU = 0.2  # [s]
BLIND_S = 2.0  # [s], after which a vehicle whose state nobody knows is stopped


class Mode(IntEnum):
    """Who flies."""

    POLICY = 0
    HOLD = 1
    """The geometric controller, at the place of the reference."""
    DESCEND = 2
    """The geometric controller, sinking."""
    BLIND = 3
    """Nobody knows the state: level by what was known last, sinking."""
    LANDED = 4
    WATCHDOG = 5
    """The watchdog's fallback: the process that flew is dead."""
    DROP = 6
    """The motors stop wherever the vehicle is: nobody has known its state for too long."""


OVER = Mode.LANDED, Mode.DROP
"""After these nothing is commanded any more."""


@dataclass(frozen=True)
class Limits:
    """What a flight must keep to."""

    low: np.ndarray
    """Corner of the geofence, world [m]."""
    high: np.ndarray
    """The other one."""
    u_min: np.ndarray
    """Smallest command [c, omega] that the vehicle takes."""
    u_max: np.ndarray
    """Largest one."""
    floor: float = 0.1
    """Height at which the vehicle has landed [m]."""
    tilt: float = 1.4
    """Angle between thrust and vertical [rad]."""
    speed: float = 15.0
    """[m/s]"""
    state_age: float = 0.1
    """Age of the newest measurement [s]."""
    policy_age: float = float("inf")
    """Flight time since the newest measurement that the policy was learnt from [s]."""

    def within(self, u: np.ndarray) -> np.ndarray:
        """Return a command [c, omega] as the vehicle takes it."""
        taken: np.ndarray = np.clip(u, self.u_min, self.u_max)
        return taken

    def broken(self, x: np.ndarray) -> str | None:
        """Return which limit a state breaks, in words; None if it keeps them all.

        Args:
            x: p, R by rows, v.
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
    """Holds a place by thrust and body rates, with integral action (Lee et al. 2010, attitude as a rotation vector)."""

    limits: Limits
    dt: float
    integral: np.ndarray = field(default_factory=lambda: np.zeros(3))
    felt: np.ndarray = field(default_factory=lambda: np.zeros(3))
    """What pushes the vehicle, low-passed, world [m/s^2]."""

    def feel(self, before: np.ndarray, after: np.ndarray, u: np.ndarray) -> None:
        """Take note of one tick: by how much the vehicle was accelerated beyond thrust and gravity.

        Args:
            before: State at its start: p, R by rows, v.
            after: State at its end.
            u: Command that acted.
        """
        a = (after[12:15] - before[12:15]) / self.dt - u[0] * before[3:12].reshape(3, 3)[:, 2] + G * UP
        if np.isfinite(a).all():
            self.felt = np.clip(self.felt + min(1.0, self.dt / FELT_TAU) * (a - self.felt), -5.0, 5.0)

    def command(self, x: np.ndarray, target: np.ndarray, velocity: np.ndarray | None = None) -> np.ndarray:
        """Return the command [c, omega].

        Args:
            x: p, R by rows, v.
            target: Where to be, world [m].
            velocity: How the target moves, world [m/s]; None: not at all.
        """
        p, R, v = x[:3], x[3:12].reshape(3, 3), x[12:15]
        error = np.clip(target - p, -1.0, 1.0)
        self.integral = np.clip(self.integral + self.dt * error, -2.0, 2.0)
        a = 4.0 * error + 2.0 * self.integral + 3.5 * ((0.0 if velocity is None else velocity) - v) - self.felt
        a[:2] *= min(1.0, 6.0 / (np.hypot(a[0], a[1]) + 1e-9))
        force = np.clip(a, -6.0, 6.0) + G * UP
        along = force / np.sqrt(force @ force)
        return self.limits.within(np.concatenate([[force @ R[:, 2]], 8.0 * turn(R, along)]))


def turn(R: np.ndarray, along: np.ndarray) -> np.ndarray:
    """Return the smallest rotation vector that points the thrust along a direction, body frame [rad]."""
    d = R.T @ along
    sine = np.hypot(d[0], d[1])
    angle = np.arctan2(sine, d[2])
    if sine < 1e-9:  # upright, or upside down, where any way round is as short
        return np.zeros(3) if d[2] > 0 else np.array([angle, 0.0, 0.0])
    rotation: np.ndarray = angle / sine * np.array([-d[1], d[0], 0.0])
    return rotation


@dataclass
class Fallback:
    """What flies when the policy must not: hold, then sink, then stop. A plain sequence, by the clock."""

    hover: GeometricHover
    hold_s: float = 2.0
    sink: float = 0.5
    """[m/s]"""
    still_s: float = 0.0
    """Time for which it has sunk without moving [s]: it stands on something."""
    sinking_s: float = 0.0
    since: float = 0.0
    """Time for which it has flown [s]."""
    blind_s: float = 0.0
    place: np.ndarray | None = None
    """Where it holds, and from where it sinks."""

    def rest(self) -> None:
        """Take note that somebody else flies: the next step is the first one of a new sequence."""
        self.since, self.blind_s, self.sinking_s, self.still_s, self.place = 0.0, 0.0, 0.0, 0.0, None
        self.hover.integral[:] = 0.0

    def step(self, x: np.ndarray, fresh: bool, target: np.ndarray, *, land: bool) -> tuple[np.ndarray, Mode]:
        """Return the command of one more tick.

        Args:
            x: Last known state: p, R by rows, v.
            fresh: Whether it is known now.
            target: Where the vehicle should be now, world [m]; where it should have been at the first call is held.
            land: Whether to sink at once.
        """
        if self.place is None:
            self.place = target.copy()
        self.since += self.hover.dt
        self.blind_s = 0.0 if fresh else self.blind_s + self.hover.dt
        if self.blind_s > BLIND_S:
            return np.zeros(4), Mode.DROP
        if self._down(x, fresh):
            return np.zeros(4), Mode.LANDED
        if not fresh:
            # Turned level within a quarter of a second of what was known; after that, straight on and gently down.
            rates = 4.0 * turn(x[3:12].reshape(3, 3), UP) if self.blind_s <= 0.25 else np.zeros(3)
            return self.hover.limits.within(np.concatenate([[0.95 * G], rates])), Mode.BLIND
        if land or self.since > self.hold_s:
            self.sinking_s += self.hover.dt
            self.place[2] = min(self.place[2], x[2] + 0.3) - self.hover.dt * self.sink
            return self.hover.command(x, self.place, -self.sink * UP), Mode.DESCEND
        return self.hover.command(x, self.place), Mode.HOLD

    def _down(self, x: np.ndarray, fresh: bool) -> bool:
        """Whether a vehicle that has been sinking is at the floor, or stands on something."""
        if not fresh or self.sinking_s < 0.2:
            return False
        moving = float(np.abs(x[12:15]).max()) > 0.1
        self.still_s = 0.0 if moving else self.still_s + self.hover.dt
        return bool(x[2] <= self.hover.limits.floor) or self.still_s > 2.0
