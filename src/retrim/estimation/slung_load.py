"""Estimate a hidden load on a cable from the acceleration that the nominal model misses.

The pull of the cable on the vehicle is part of this acceleration. An extended Kalman filter estimates the direction of
the cable, its rate, the mass of the load and the length of the cable, together with three other causes of missed
acceleration: a slow push, a linear drag and an error of the thrust gain. The filter receives neither the mass nor the
length. The motion of the vehicle drives the model of the load, so an exact model of the vehicle is not needed: with q
the unit vector from the vehicle to the load, a the measured acceleration, g gravity and l the length,

    q'' = (g - a - q q . (g - a)) / l - |q'|^2 q,       pull = share q max(q . (g - a) + l |q'|^2, 0),

where ``share`` is the mass of the load as a share of the vehicle's. A slack cable is treated as one without pull whose
load moves on a sphere. When measurements contradict the filter for several ticks, as after a pick-up or a release, the
uncertainty returns to that of the start.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from ..physics.state import STANDARD_GRAVITY, where

PRIOR_MEAN = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -0.6, 0.2, 0.0)
PRIOR = (0.15, 0.15, 1.0, 1.0, 0.5, 0.5, 0.5, 0.2, 0.4, 0.2, 0.03)
"""Mean and standard deviation at the start: horizontal direction [-] and its rate [1/s], push [m/s^2], share [-],
logarithm of the length in metres, drag [1/s], relative error of the thrust gain."""
WALK = (0.0, 0.0, 0.3, 0.3, 0.3, 0.3, 0.3, 0.01, 0.03, 0.01, 0.003)
"""Standard deviation of the random walk of each number in one second."""
NOISE = 0.3  # [m/s^2], standard deviation of a missed acceleration without measurement noise
AXES = 3.0  # expected sum of the squared innovations of a tick, relative to their variances
LOAD_ENTRIES = (True,) * 4 + (False,) * 3 + (True, True, False, False)  # numbers that describe the load
GATE = 4.0  # standard deviations; a missed acceleration farther off corrects no more than one at this distance
PATIENCE = 0.5  # [s], time after a change in which no other one is noticed, since the filter must settle
SURPRISE = 12.0  # mean squared innovation [variances, of 3 axes] that shows a change
SURPRISE_TAU = 0.06  # [s], time constant of this mean
LARGEST_DEVIATION = 3.0  # largest standard deviation, in those of the start
LIGHT_SHARE = 0.05  # share below which the direction of the load fades, since it cannot be observed
STEEPEST = 0.98  # largest horizontal part of the direction
HEAVIEST, SHORTEST, LONGEST = 1.5, 0.1, 5.0  # largest share; bounds of the length [m]


class Load(eqx.Module):
    """The numbers of the filter with their names."""

    n: Float[Array, "2"]
    """Horizontal part of the direction from the vehicle to the load."""
    w: Float[Array, "2"]
    """Rate of this part [1/s]."""
    push: Float[Array, "3"]
    """Slow part of the missed acceleration, world [m/s^2]."""
    share: Float[Array, ""]
    """Mass of the load as a share of the vehicle's mass."""
    length: Float[Array, ""]
    """Length of the cable [m]."""
    drag: Float[Array, ""]
    """Linear drag [1/s]."""
    gain: Float[Array, ""]
    """Relative error of the thrust gain."""

    @classmethod
    def of(cls, z: Float[Array, "11"]) -> "Load":
        """Return the numbers of the filter's mean."""
        return cls(z[:2], z[2:4], z[4:7], z[7], jnp.exp(z[8]), z[9], z[10])

    @property
    def direction(self) -> Float[Array, "3"]:
        """Unit vector from the vehicle to the load."""
        return jnp.append(self.n, -self._down())

    @property
    def rate(self) -> Float[Array, "3"]:
        """Rate of the direction [1/s]."""
        return jnp.append(self.w, jnp.sum(self.n * self.w) / self._down())

    def pull(self, a: Float[Array, "3"]) -> Float[Array, "3"]:
        """Return the acceleration of the vehicle by the cable, world [m/s^2], for the vehicle's acceleration ``a``."""
        q, q_dot = self.direction, self.rate
        tension = jnp.sum(q * (_gravity(a.dtype) - a)) + self.length * jnp.sum(q_dot * q_dot)
        return self.share * jnp.maximum(tension, 0.0) * q

    def after(self, h: float | Float[Array, ""], a: Float[Array, "3"]) -> "Load":
        """Return the load ``h`` seconds later, by one step of the midpoint method.

        Args:
            h: Time [s].
            a: Mean acceleration of the vehicle over this time, world [m/s^2].
        """
        middle = self._advance(0.5 * h, self.w, self._acceleration(a))
        return self._advance(h, middle.w, middle._acceleration(a))

    def _down(self) -> Float[Array, ""]:
        return jnp.sqrt(1.0 - jnp.minimum(jnp.sum(self.n * self.n), STEEPEST**2))

    def _acceleration(self, a: Float[Array, "3"]) -> Float[Array, "2"]:
        q, q_dot = self.direction, self.rate
        force = _gravity(a.dtype) - a
        across = force - q * jnp.sum(q * force)
        return (across / self.length - jnp.sum(q_dot * q_dot) * q)[:2]

    def _advance(self, h: float | Float[Array, ""], w: Float[Array, "2"], w_dot: Float[Array, "2"]) -> "Load":
        return dataclasses.replace(self, n=self.n + h * w, w=self.w + h * w_dot)

    def vector(self) -> Float[Array, "11"]:
        """Return the mean of the filter, the inverse of :meth:`of`."""
        rest = jnp.stack([self.share, jnp.log(self.length), self.drag, self.gain])
        return jnp.concatenate([self.n, self.w, self.push, rest])


class LoadEstimate(eqx.Module):
    """Mean and covariance of the filter, and its recent surprise."""

    z: Float[Array, "11"]
    P: Float[Array, "11 11"]
    surprise: Float[Array, ""]
    """Mean squared innovation, relative to its variance, of the last few ticks."""
    since: Float[Array, ""]
    """Time since the start or the last change [s]."""

    @classmethod
    def start(cls, dtype: jnp.dtype) -> "LoadEstimate":
        """Return the estimate before the first measurement."""
        mean, P = jnp.array(PRIOR_MEAN, dtype=dtype), jnp.diag(jnp.array(PRIOR, dtype=dtype) ** 2)
        return cls(mean, P, jnp.array(AXES, dtype=dtype), jnp.zeros((), dtype=dtype))

    @property
    def load(self) -> Load:
        """The most likely load."""
        return Load.of(self.z)

    def predict(self, a: Float[Array, "3"], dt: float) -> "LoadEstimate":
        """Return the estimate one tick later.

        Args:
            a: Mean acceleration of the vehicle over the tick, world [m/s^2].
            dt: Control tick [s].
        """

        def step(z: Float[Array, "11"]) -> Float[Array, "11"]:
            load = Load.of(z).after(dt, a)
            remains = jnp.exp(-dt * jnp.maximum(0.0, 1.0 - load.share / LIGHT_SHARE))
            return dataclasses.replace(load, n=remains * load.n, w=remains * load.w).vector()

        F = jax.jacfwd(step)(self.z)
        P = F @ self.P @ F.T + dt * jnp.diag(jnp.array(WALK, dtype=self.P.dtype) ** 2)
        # The direction of a load without mass cannot be observed: its uncertainty must not grow beyond all bounds.
        widest = LARGEST_DEVIATION * jnp.array(PRIOR, dtype=P.dtype)
        variances = jnp.sum(jnp.eye(P.shape[0], dtype=P.dtype) * P, axis=0)  # jnp.diagonal has no NumPy form on board
        shrink = jnp.minimum(1.0, widest / jnp.sqrt(jnp.maximum(variances, 1e-12)))
        return LoadEstimate(_limit(step(self.z)), shrink[:, None] * P * shrink[None], self.surprise, self.since)

    def correct(
        self,
        missed: Float[Array, "3"],
        a: Float[Array, "3"],
        v: Float[Array, "3"],
        thrust: Float[Array, "3"],
        noise: Float[Array, ""],
        valid: Bool[Array, ""],
        dt: float,
    ) -> "LoadEstimate":
        """Return the estimate corrected by the missed acceleration of the last tick.

        Args:
            missed: Acceleration that the nominal model missed, mean over the tick, world [m/s^2].
            a: Mean acceleration of the vehicle over the tick, world [m/s^2].
            v: Mean velocity over the tick, world [m/s].
            thrust: Mean mass-normalised thrust over the tick, world [m/s^2].
            noise: Standard deviation of a measured velocity [m/s].
            valid: Whether the missed acceleration is that of the last tick.
            dt: Control tick [s].
        """

        def expected(z: Float[Array, "11"]) -> Float[Array, "3"]:
            load = Load.of(z)
            middle = load.after(-0.5 * dt, a)
            return load.push - load.drag * v + load.gain * thrust + middle.pull(a)

        level = missed - expected(self.z)
        H = jax.jacfwd(expected)(self.z)
        r = NOISE**2 + 2.0 * (noise / dt) ** 2
        counts = valid.astype(self.P.dtype)

        def scalar(carry: tuple[Array, Array], row: tuple[Array, Array]) -> tuple[tuple[Array, Array], Array]:
            (off, P), (h, level) = carry, row
            Ph = P @ h
            s = jnp.sum(h * Ph) + r
            innovation = level - jnp.sum(h * off)
            gain, limit = counts * Ph / s, GATE * jnp.sqrt(s)
            return (off + gain * jnp.clip(innovation, -limit, limit), P - jnp.outer(gain, Ph)), innovation**2 / s

        (off, P), squares = lax.scan(scalar, (jnp.zeros_like(self.z), self.P), (H, level))
        share = counts * (1.0 - jnp.exp(-dt / SURPRISE_TAU))
        surprise, since = self.surprise + share * (jnp.sum(squares) - self.surprise), self.since + dt
        changed = (surprise > SURPRISE) & (since > PATIENCE)
        # After a change, the load may be a different one; the other causes of missed acceleration remain.
        start = LoadEstimate.start(P.dtype)
        is_new = jnp.array(LOAD_ENTRIES) & changed
        P = jnp.where(is_new[:, None] | is_new[None], start.P, 0.5 * (P + P.T))
        z = _limit(jnp.where(is_new, start.z, jnp.where(changed, self.z, self.z + off)))
        surprise, since = jnp.where(changed, AXES, surprise), jnp.where(changed, 0.0, since)
        after = LoadEstimate(z, P, surprise, since.astype(P.dtype))
        finite = jnp.all(jnp.isfinite(P)) & jnp.all(jnp.isfinite(z)) & jnp.isfinite(surprise)
        return where(finite, after, start)


def _limit(z: Float[Array, "11"]) -> Float[Array, "11"]:
    norm = jnp.sqrt(jnp.sum(z[:2] * z[:2]) + 1e-12)
    n = z[:2] * jnp.minimum(1.0, STEEPEST / norm)
    length = jnp.clip(z[8], jnp.log(SHORTEST), jnp.log(LONGEST))
    rest = jnp.stack([jnp.clip(z[7], 0.0, HEAVIEST), length, z[9], z[10]])
    return jnp.concatenate([n, z[2:7], rest])


def _gravity(dtype: jnp.dtype) -> Float[Array, "3"]:
    return jnp.array([0.0, 0.0, -STANDARD_GRAVITY], dtype=dtype)
