"""DATT's training problem: random references under a random disturbance, in the nominal model with actuator lag."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import random
from jaxtyping import Array, Float, Int, Key

from retrim.learn.problem import Outcome
from retrim.physics import so3
from retrim.physics.actuators import apply_lag
from retrim.physics.dynamics import PointMass
from retrim.physics.state import Command, State

from .controller import POINTS, SPACING, datt_command, datt_observation

EPISODE = 10.0  # [s]
TICK = 0.02  # [s], tick for WALK and DISCOUNT; for a different tick they are scaled to the same effect per second
WALK = 0.02  # [m/s^2], standard deviation of a disturbance step, per axis
DISCOUNT = 0.99
MAX_DISTURBANCE = 1.0  # [m/s^2], largest disturbance per axis


class DattEnv(NamedTuple):
    """State of an episode."""

    x: State
    acting: Command
    """Command that acts now, after the actuator lag."""
    d: Float[Array, "3"]
    """Disturbance, world frame [m/s^2]."""
    reference: Int[Array, ""]
    """Index of the reference in the bank."""
    tick: Int[Array, ""]


class DattProblem(eqx.Module):
    """The environment; see :class:`retrim.learn.problem.Problem`."""

    bank: Float[Array, "n ticks 3"]
    """Reference positions, around the origin [m]."""
    tau: Float[Array, ""]
    """Actuator time constant [s]."""
    low: Command
    high: Command
    dt: float = eqx.field(static=True, default=0.02)

    def reset(self, key: Key[Array, ""]) -> DattEnv:
        """Begin near the start of a random reference, slightly tilted, under a random disturbance."""
        k_p, k_v, k_a, k_yaw, k_d, k_r = random.split(key, 6)
        number = random.randint(k_r, (), 0, self.bank.shape[0])
        p = self.bank[number, 0] + random.uniform(k_p, (3,), minval=-0.7, maxval=0.7)
        tilt = jnp.append(0.3 * random.uniform(k_a, (2,), minval=-1.0, maxval=1.0), 0.0)
        R = so3.rotz(0.5 * random.normal(k_yaw, ())) @ so3.exp(tilt)
        x = State(p, R, 0.3 * random.normal(k_v, (3,)))
        d = random.uniform(k_d, (3,), minval=-MAX_DISTURBANCE, maxval=MAX_DISTURBANCE)
        return DattEnv(x, Command.hover(p.dtype), d, number, jnp.array(0))

    def observe(self, s: DattEnv, key: Key[Array, ""]) -> Float[Array, " o"]:
        """Return the policy's observation, with 5 mm of position noise, as in DATT."""
        every = round(SPACING / self.dt)
        at = jnp.minimum(s.tick + every * jnp.arange(POINTS), self.bank.shape[1] - 1)
        x = State(s.x.p + 0.005 * random.normal(key, (3,), s.x.p.dtype), s.x.R, s.x.v)
        return datt_observation(x, s.acting, s.d, self.bank[s.reference, at])

    def step(self, s: DattEnv, action: Float[Array, "4"], key: Key[Array, ""]) -> tuple[DattEnv, Outcome]:
        """Fly one tick; as in DATT, the reward is -(distance + half the heading + a tenth of the speed)."""
        mean, acting = apply_lag(s.acting, datt_command(action, self.low, self.high), self.dt, self.tau)
        x = PointMass(self.dt).step(s.x, mean, s.d)
        walk = WALK * (self.dt / TICK) ** 0.5
        d = jnp.clip(s.d + walk * random.normal(key, (3,), s.d.dtype), -MAX_DISTURBANCE, MAX_DISTURBANCE)
        after = DattEnv(x, acting, d, s.reference, s.tick + 1)
        away = jnp.sqrt(jnp.sum((x.p - self.bank[s.reference, s.tick + 1]) ** 2) + 1e-12)
        heading = jnp.arctan2(x.R[1, 0], x.R[0, 0])
        speed = jnp.sqrt(jnp.sum(x.v * x.v) + 1e-12)
        reward = -(jnp.minimum(away, 5.0) + 0.5 * jnp.abs(heading) + 0.1 * jnp.minimum(speed, 1.0))
        is_lost = away > 5.0
        reward = jnp.where(is_lost, reward / (1.0 - discount(self.dt)), reward)  # as if the vehicle stayed there
        return after, Outcome(reward, is_lost, after.tick >= ticks_of(self.dt))


def discount(dt: float) -> float:
    """Return the discount for a tick of ``dt`` [s]."""
    return float(DISCOUNT ** (dt / TICK))


def ticks_of(dt: float) -> int:
    """Return the length of an episode in ticks of ``dt`` [s]."""
    return round(EPISODE / dt)


def reference_bank(seed: int, n: int = 512, *, dt: float = 0.02) -> np.ndarray:
    """Return random references: points, zigzags, chains of polynomials and Lissajous figures, a quarter each.

    Args:
        seed: Seed for all references.
        n: Number of references.
        dt: Time between rows [s].

    Returns:
        Positions around the origin, shape (n, ticks, 3) [m].
    """
    draw, ticks = np.random.default_rng(seed), ticks_of(dt) + POINTS * round(SPACING / dt) + 1
    t = dt * np.arange(ticks)
    bank = np.zeros((n, ticks, 3))
    for i in range(n):
        if i % 4:
            bank[i] = (_zigzag, _chain, _lissajous)[i % 4 - 1](draw, t)
    return bank


def _zigzag(draw: np.random.Generator, t: np.ndarray) -> np.ndarray:
    """Return straight lines of 0.6 to 1.5 s each between way-points on alternating sides."""
    knots = np.concatenate([[0.0], np.cumsum(draw.uniform(0.6, 1.5, 30))])
    sides = np.where(np.arange(len(knots)) % 2, 1.0, -1.0)[:, None]
    points = sides * draw.uniform(0.0, 1.0, (len(knots), 3)) * np.array([1.0, 1.0, 0.3])
    points[0] = 0.0
    return np.stack([np.interp(t, knots, points[:, axis]) for axis in range(3)], axis=1)


def _chain(draw: np.random.Generator, t: np.ndarray) -> np.ndarray:
    """Return chains of cubics of 1.2 to 4 s each, per axis, through the origin, with continuous speeds at the knots."""
    path = np.zeros((len(t), 3))
    for axis, share in enumerate((1.0, 1.0, 0.3)):
        knots = np.concatenate([[0.0], np.cumsum(draw.uniform(1.2, 4.0, 12))])
        speeds = share * draw.uniform(-2.5, 2.5, len(knots))
        speeds[0] = 0.0
        which = np.clip(np.searchsorted(knots, t, side="right") - 1, 0, len(knots) - 2)
        T = knots[which + 1] - knots[which]
        s = (t - knots[which]) / T
        path[:, axis] = T * (speeds[which] * s * (1 - s) ** 2 - speeds[which + 1] * s**2 * (1 - s))
    return path


def _lissajous(draw: np.random.Generator, t: np.ndarray) -> np.ndarray:
    """Return a sine along each axis, up to 1.5 m and with a period of 2.5 to 6 s, which speeds up for two seconds."""
    period, phase = draw.uniform(2.5, 6.0), draw.uniform(0.0, 2.0 * np.pi, 3)
    size = draw.uniform(0.2, 1.0, 3) * np.array([1.5, 1.5, 0.3])
    beats = np.array([1.0, draw.integers(1, 3), 1.0])
    clock = np.where(t < 2.0, t**2 / 4.0, t - 1.0)
    path: np.ndarray = size * (np.sin(2.0 * np.pi * np.outer(clock, beats) / period + phase) - np.sin(phase))
    return path
