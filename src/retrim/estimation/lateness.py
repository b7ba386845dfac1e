"""Estimate the undeclared lateness of measured states, by comparison with an inertial unit, which has no latency.

A motion-capture system or a state estimator may deliver states that are older than declared. The rotation and the
change in velocity from one state to the next then equal earlier readings of the gyroscope and the accelerometer. Each
candidate is a whole number of ticks; its probability follows from the differences between the two.
"""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ..physics import so3
from ..physics.state import State, where
from .consistency import ACCELERATION, RATE

LONGEST = 0.12  # [s], longest lateness
LONGEST_AGE = 0.1  # [s], longest declared age
PUNCTUAL = 8.0  # log of the prior odds of states that are as old as declared against each candidate
MOST_EVIDENCE = 30.0  # largest log odds, so that a change in lateness is soon found
NOISE_TAU = 1.0  # [s], memory of the noise and of constant differences
NOISE = (0.02, 0.1)  # [rad/s] and [m/s^2], smallest standard deviations of the differences
MODEL_ERROR = 0.5  # error of the compared readings, as a share of the largest difference between successive candidates
PACE = 0.4  # [-], largest rate of change of the value: the time of the states always advances, by most of a tick
OUTLIER = 4.0  # standard deviations to which a difference is limited
INFORMATION = 0.3  # share of the evidence that counts, since successive differences are correlated


class Lateness(eqx.Module):
    """Memory of the estimate."""

    omega: Float[Array, "k 3"]
    """Readings of the gyroscope, newest first [rad/s]."""
    a: Float[Array, "k 3"]
    """Readings of the accelerometer, newest first: means over a tick, world [m/s^2]."""
    log_odds: Float[Array, " candidates"]
    """Logarithm of the probability of each candidate, up to a constant."""
    mean: Float[Array, "2 3"]
    """Mean difference between states and readings of the two sensors, e.g. from their biases."""
    variance: Float[Array, "2"]
    """Variance of this difference."""
    value: Float[Array, ""]
    """Lateness in use [s], which follows the mean lateness slowly; it is zero at the start."""
    is_first: Bool[Array, ""]
    """Whether the next reading is the first."""
    ticks: Int[Array, ""]
    """Number of readings since a tick was missed, at most the number that is stored."""

    @classmethod
    def start(cls, dt: float, dtype: jnp.dtype) -> "Lateness":
        """Return the memory before the first measurement.

        Args:
            dt: Control tick [s].
            dtype: Type of the arrays.
        """
        candidates = math.floor(LONGEST / dt) + 1
        readings = jnp.zeros((candidates + math.ceil(LONGEST_AGE / dt) + 2, 3), dtype)
        log_odds = jnp.where(jnp.arange(candidates) == 0, 0.0, -PUNCTUAL).astype(dtype)
        mean, variance = jnp.zeros((2, 3), dtype), jnp.array(NOISE, dtype) ** 2
        zero, full = jnp.zeros((), dtype), jnp.array(readings.shape[0])
        return cls(readings, readings, log_odds, mean, variance, zero, jnp.array(True), full)

    def late_readings(self, dt: float) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
        """Return the readings that are as late as the states: body rates [rad/s], acceleration, world [m/s^2].

        Args:
            dt: Control tick [s].
        """
        ticks = self.value / dt
        return _at(self.omega, ticks), _at(self.a, ticks)

    def observe(
        self,
        before: State,
        x: State,
        successive: Bool[Array, ""],
        usable: Bool[Array, ""],
        omega: Float[Array, "3"],
        a: Float[Array, "3"],
        age: Float[Array, ""],
        dt: float,
    ) -> "Lateness":
        """Return the memory after a tick.

        Args:
            before: State measured one tick ago.
            x: Measured state.
            successive: Whether one tick separates the two states.
            usable: Whether the step between the two states is a possible motion.
            omega: Measured body rates [rad/s].
            a: Measured acceleration, the mean over the last tick, world [m/s^2].
            age: Declared age of ``x`` [s].
            dt: Control tick [s].
        """
        dtype = self.log_odds.dtype
        before, x, omega, a, age = jax.tree.map(lambda leaf: leaf.astype(dtype), (before, x, omega, a, age))
        omegas, accelerations = (
            self._remember(old, jnp.where(jnp.all(jnp.abs(new) < limit), new, old[0]))
            for new, old, limit in ((omega, self.omega, RATE), (a, self.a, ACCELERATION))
        )
        motion = jnp.stack([so3.log(so3.mul(before.R.T, x.R)), x.v - before.v]) / dt
        ages = age / dt + jnp.arange(self.log_odds.shape[0], dtype=dtype)
        rates = 0.5 * (omegas[:-1] + omegas[1:])
        candidates = jax.vmap(lambda ticks: jnp.stack([_at(rates, ticks), _at(accelerations, ticks)]))(ages)
        spread = jnp.max(jnp.mean((candidates[1:] - candidates[:-1]) ** 2, axis=2), axis=0)
        variance = self.variance + MODEL_ERROR**2 * spread
        deviation = motion[None] - candidates - self.mean[None]
        misfit = jnp.minimum(jnp.sum(deviation**2, axis=2) / variance[None], OUTLIER**2)
        log_odds = self.log_odds - 0.5 * INFORMATION * jnp.sum(misfit, axis=1)
        log_odds = jnp.maximum(log_odds - jnp.max(log_odds), -MOST_EVIDENCE)
        best, share = jnp.argmax(log_odds), 1.0 - math.exp(-dt / NOISE_TAU)
        limit = OUTLIER * jnp.sqrt(variance)[:, None]
        size = jnp.minimum(jnp.mean(deviation[best] ** 2, axis=1), OUTLIER**2 * variance)
        mean = self.mean + share * jnp.clip(deviation[best], -limit, limit)
        least = jnp.array(NOISE, dtype) ** 2
        estimate = (log_odds, mean, jnp.maximum(self.variance + share * (size - self.variance), least))
        # After a missed tick, the stored readings are older than their places in the history.
        most = omegas.shape[0]
        ticks = jnp.where(successive | self.is_first, jnp.minimum(self.ticks + 1, most), 0)
        valid = usable & (ticks == most) & (age <= LONGEST_AGE) & jnp.all(jnp.isfinite(motion))
        estimate = where(valid, estimate, (self.log_odds, self.mean, self.variance))
        value = self.value + jnp.clip(_mean_lateness(estimate[0], dt) - self.value, -PACE * dt, PACE * dt)
        return Lateness(omegas, accelerations, *estimate, value, jnp.array(False), ticks)

    def _remember(self, readings: Float[Array, "k 3"], new: Float[Array, "3"]) -> Float[Array, "k 3"]:
        """Return the readings after a new one; the vehicle has hovered before the first, perhaps with a bias."""
        return jnp.where(self.is_first, new[None], jnp.concatenate([new[None], readings[:-1]]))


def _mean_lateness(log_odds: Float[Array, " candidates"], dt: float) -> Float[Array, ""]:
    """Return the mean lateness [s]; zero if the states are more likely as old as declared than not."""
    share = jax.nn.softmax(log_odds)
    mean = dt * share @ jnp.arange(share.shape[0], dtype=share.dtype)
    return jnp.where(share[0] > 0.5, 0.0, mean)


def _at(readings: Float[Array, "k 3"], age: Float[Array, ""]) -> Float[Array, "3"]:
    """Return the reading that is ``age`` ticks old, by linear interpolation."""
    whole = jnp.clip(jnp.floor(age).astype(int), 0, readings.shape[0] - 2)
    share = jnp.clip(age - whole, 0.0, 1.0).astype(readings.dtype)
    return (1.0 - share) * readings[whole] + share * readings[whole + 1]
