"""Test whether a rigid body can have moved from one measurement to the next.

A single wrong velocity enters two accelerations with opposite signs and 50 times its size (at 50 Hz), so one
sample in a window can outweigh all others. These tests need neither a vehicle model nor a history. The disturbance
observer, which receives one pair per tick, and the learners, which receive a window, share these tests.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..physics import so3
from ..physics.state import State, where

SPEED = 0.25  # [m/s], tolerated difference between a velocity and the derivative of the position, e.g. a small bias
SPREADS = 4.0  # standard deviations tolerated beyond SPEED; normal noise exceeds them in < 1 of 10^4 cases
NOISE_PRIOR = 1e-3  # [m], noise assumed before the first measurement
NOISE_LIMIT = 3e-3  # [m]; larger noise is a fault, since otherwise every fault would look like noise
NOISE_TAU = 1.0  # [s], memory of the noise
JUMP = 3.0**0.5  # ratio of the mean change of a gap to the mean gap, for white noise in the positions
ACCELERATION = 150.0  # [m/s^2], beyond any vehicle of this kind, including a push and a collision with air
RATE = 40.0  # [rad/s], beyond any commanded rate of a vehicle of this kind
REST = 1e-3  # [m/s]; a slower vehicle may be measured twice in the same state
SCALE = 0.25  # largest relative difference between the motion and that implied by the velocities
CORRELATED = 0.5  # smallest squared correlation of gaps and steps that shows a wrong scale
MOTION, OVER_NOISE = 0.15, 3.0  # [m/s], and multiple of the noise of gaps: smallest mean motion that shows a scale
SCALE_TAU = 1.0  # [s], memory of the moments that show a scale
DOUBT_TAU = 0.3  # [s], memory of the share of unusable steps
SKEW = 0.1  # largest entry of R^T R - I for a rotation


class Findings(eqx.Module):
    """Contradictions between two successive measurements; all false for a possible motion."""

    repeated: Bool[Array, ""]
    """The second measurement equals the first one bit for bit, although the vehicle is moving."""
    velocity: Bool[Array, ""]
    """The velocity is not the derivative of the position."""
    acceleration: Bool[Array, ""]
    """The acceleration is beyond the capability of a vehicle."""
    attitude: Bool[Array, ""]
    """An attitude is not a rotation, or the vehicle turned faster than it can."""
    not_finite: Bool[Array, ""]

    @property
    def any(self) -> Bool[Array, "..."]:
        """Whether there is a contradiction."""
        result: Bool[Array, ...] = jnp.any(jnp.stack(jax.tree.leaves(self)), axis=0)
        return result


def gap(before: State, after: State, dt: float) -> Float[Array, "3"]:
    """Return the position step minus the step that the mean of the two velocities implies, in the world frame [m].

    The error of the trapezoidal rule is dt^3 / 12 times the jerk, which is 0.1 mm at 50 Hz in the most agile flight.
    """
    return after.p - before.p - 0.5 * dt * (before.v + after.v)


def gap_noise(before: Float[Array, "3"], after: Float[Array, "3"]) -> Float[Array, ""]:
    """Return the size of the noise, estimated from two successive gaps [m].

    Velocities with a bias or a wrong scale cause gaps that hardly change, and such gaps do not count as noise.
    """
    return jnp.sqrt(jnp.sum((after - before) ** 2) + 1e-20) / JUMP


class Scale(eqx.Module):
    """Moments of gaps, and of steps from velocities; the covariance of both shows a wrong scale of the velocities."""

    gap: Float[Array, "3"]
    """Mean gap, world [m]."""
    step: Float[Array, "3"]
    """Mean step, world [m]."""
    product: Float[Array, ""]
    """Mean of gap times step [m^2]."""
    squares: Float[Array, "2"]
    """Means of the squared gap and step [m^2]."""

    @classmethod
    def of(cls, missing: Float[Array, "3"], v: Float[Array, "3"], dt: float) -> "Scale":
        """Return the moments of one step with the :func:`gap` ``missing`` and the velocity ``v``."""
        step = dt * v
        return cls(missing, step, jnp.sum(missing * step), jnp.stack([jnp.sum(missing**2), jnp.sum(step**2)]))

    def verdict(self, dt: float, noise: Float[Array, ""]) -> tuple[Bool[Array, ""], Bool[Array, ""]]:
        """Return whether the vehicle moved enough to show the scale, and whether the scale is wrong.

        Constant errors of the velocity do not count, since the moments are centred.

        Args:
            dt: Control tick [s].
            noise: Typical size of a gap due to noise [m].
        """
        covariance = self.product - jnp.sum(self.gap * self.step)
        gaps = self.squares[0] - jnp.sum(self.gap**2)
        steps = self.squares[1] - jnp.sum(self.step**2)
        shows = gaps + steps > (MOTION * dt) ** 2 + (OVER_NOISE * jnp.minimum(noise, NOISE_LIMIT)) ** 2
        wrong = (jnp.abs(covariance) > SCALE * steps) & (covariance**2 > CORRELATED * gaps * steps)
        return shows, wrong


def contradictions(before: State, after: State, dt: float, noise: Float[Array, ""]) -> Findings:
    """Return the contradictions in the motion from one measurement to the next.

    Args:
        before: First measurement.
        after: Measurement one tick later.
        dt: Control tick [s].
        noise: Typical size of a :func:`gap` due to noise in this flight [m]; see :func:`gap_noise`.
    """
    same = [jnp.all(a == b) for a, b in ((before.p, after.p), (before.R, after.R), (before.v, after.v))]
    slack = SPEED * dt + SPREADS * jnp.minimum(noise, NOISE_LIMIT)
    gap_size, a = gap(before, after, dt), (after.v - before.v) / dt
    skew = jnp.max(jnp.abs(so3.mul(after.R.T, after.R) - jnp.eye(3, dtype=after.R.dtype)))
    rate = so3.log(so3.mul(before.R.T, after.R)) / dt
    finite = jnp.isfinite(jnp.sum(after.p) + jnp.sum(after.R) + jnp.sum(after.v))
    return Findings(
        repeated=same[0] & same[1] & same[2] & (jnp.sum(before.v * before.v) > REST**2),
        velocity=jnp.sum(gap_size * gap_size) > slack * slack,
        acceleration=jnp.sum(a * a) > ACCELERATION**2,
        attitude=(skew > SKEW) | (jnp.sum(rate * rate) > RATE**2),
        not_finite=~finite,
    )


class Consistency(eqx.Module):
    """Memory of the tests in flight, updated every tick."""

    gap: Float[Array, "3"]
    """Last :func:`gap`, world [m]."""
    noise: Float[Array, ""]
    """Typical size of a gap due to noise [m]."""
    scale: Scale
    """Moments over the last second."""
    scaled: Bool[Array, ""]
    """Whether the velocities had a wrong scale when the vehicle last moved."""
    repeated: Bool[Array, ""]
    """Whether the last measurement equals the one before it, e.g. after a dropped frame."""
    possible: Bool[Array, ""]
    """Whether the last measurement did not contradict the one before it."""
    certain: Bool[Array, ""]
    """Whether the step to the last measurement is usable: neither end contradicts the measurement before it."""
    doubt: Float[Array, ""]
    """Share of unusable steps among the last few; one at the start, until a step has been tested."""

    @classmethod
    def start(cls, x: State) -> "Consistency":
        """Return the memory before the first measurement ``x``."""
        zero, yes = jnp.zeros_like(x.p[0]), jnp.array(True)
        scale = Scale(jnp.zeros_like(x.p), jnp.zeros_like(x.p), zero, jnp.zeros_like(x.p[:2]))
        return cls(jnp.zeros_like(x.p), jnp.full_like(zero, NOISE_PRIOR), scale, ~yes, ~yes, yes, yes, zero + 1.0)

    def after(self, before: State, x: State, dt: float, successive: Bool[Array, ""]) -> "Consistency":
        """Return the memory after a new measurement.

        Args:
            before: Last measurement.
            x: New measurement.
            dt: Control tick [s].
            successive: Whether one tick separates the two measurements; otherwise they are not compared.
        """
        missing, v = gap(before, x, dt), 0.5 * (before.v + x.v)
        result = contradictions(before, x, dt, self.noise)
        possible = ~(successive & result.any)
        moving = jax.tree.map(lambda old, new: old + dt / SCALE_TAU * (new - old), self.scale, Scale.of(missing, v, dt))
        scale = where(successive & possible & self.possible, moving, self.scale)
        shows, wrong = scale.verdict(dt, self.noise)
        has_wrong_scale = jnp.where(shows, wrong, self.scaled)
        certain = possible & self.possible & ~has_wrong_scale
        doubt = self.doubt + dt / DOUBT_TAU * (jnp.where(certain, 0.0, 1.0) - self.doubt)
        new = jnp.minimum(gap_noise(self.gap, missing), NOISE_LIMIT)
        noise = self.noise + (1.0 - jnp.exp(-dt / NOISE_TAU)) * (new - self.noise)
        noise = jnp.where(successive & possible & self.possible, noise, self.noise)
        return Consistency(
            missing, noise, scale, has_wrong_scale, successive & result.repeated, possible, certain, doubt
        )
