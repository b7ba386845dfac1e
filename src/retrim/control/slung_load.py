"""Compensate the pull of a load on a cable, and damp its swing.

The load is estimated (:mod:`retrim.estimation.slung_load`). Its pull at the time at which a command acts is part of the
disturbance that turns the frame of the effective gravity. A vehicle that holds its position exactly leaves the swing
undamped, so the frame also moves: it accelerates in the direction of the swing, in proportion to the velocity of the
load relative to the vehicle, which takes energy from the swing (:class:`Sway`). The policy flies its task in the moving
frame.

A swing that the reference demands is not damped. The expected load hangs on a vehicle that follows the reference
exactly; only the difference from its swing counts.
"""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..estimation.slung_load import Load, LoadEstimate
from ..physics import so3
from ..physics.state import STANDARD_GRAVITY, Command, State
from ..tasks.task import AbstractTask

# [m/s^2] and [s]: a reference whose acceleration is smaller, now and a little later, rests, and no swing is expected.
REST, SHORT_TIME = 0.3, 0.2
# [1/s], acceleration of the frame per velocity of the load relative to the vehicle. At rest, a fast decay of the swing
# matters more than the motion; on a path, the error of the path matters more.
GAIN, GAIN_AT_REST = 1.0, 3.0
DECAY_RATE, REST_DECAY_RATE = 0.1, 4.0  # [1/s], rates at which the expected swing decays
HALVING_DEVIATION = 0.2  # [m/s], standard deviation of the velocity of the load at which the motion is halved
LIGHT_SHARE = 0.1  # share of the load below which the motion is smaller, since a light load matters less
LARGEST_ACCELERATION = 2.0  # [m/s^2], largest acceleration of the frame
# Frequency of the critically damped return of the frame, as a share of that of the swing below a fixed vehicle. It lets
# the motion of the frame lead the swing by 20 degrees, which is about the lag of the vehicle.
RETURN = 0.18


class Sway(eqx.Module):
    """Motion of the frame relative to the world."""

    p: Float[Array, "3"]
    """Offset of its origin, world [m]."""
    v: Float[Array, "3"]
    """Velocity, world [m/s]."""
    a: Float[Array, "3"]
    """Acceleration, world [m/s^2]."""


class LoadMemory(eqx.Module):
    """Memory of the compensation."""

    estimate: LoadEstimate
    expected: Load
    """Load on a vehicle that follows the reference exactly."""
    sway: Sway


class LoadCompensation(eqx.Module):
    """Estimates the load, its pull on the vehicle, and the motion that damps its swing."""

    task: AbstractTask
    """Task, which provides the acceleration of the reference."""

    def init(self, x: State) -> LoadMemory:
        """Return the memory at the start of a flight."""
        zero = jnp.zeros_like(x.p)
        estimate = LoadEstimate.start(x.p.dtype)
        return LoadMemory(estimate, estimate.load, Sway(zero, zero, zero))

    def predict(self, s: LoadMemory, last: State, x: State, dt: float) -> tuple[LoadMemory, Float[Array, "3"]]:
        """Return the memory with the load at the end of the last tick, and the predicted mean pull over it [m/s^2].

        Args:
            s: Memory.
            last: State measured one tick ago.
            x: Measured state.
            dt: Control tick [s].
        """
        a = (x.v - last.v) / dt
        estimate = s.estimate.predict(a, dt)
        return dataclasses.replace(s, estimate=estimate), estimate.load.after(-0.5 * dt, a).pull(a)

    def correct(
        self,
        s: LoadMemory,
        missed: Float[Array, "3"],
        last: State,
        x: State,
        u: Command,
        noise: Float[Array, ""],
        valid: Bool[Array, ""],
        dt: float,
    ) -> LoadMemory:
        """Return the memory with the load corrected by the missed acceleration.

        Args:
            s: Memory.
            missed: Mean acceleration that the nominal model missed in the last tick, world [m/s^2].
            last: State measured one tick ago.
            x: Measured state.
            u: Mean thrust and body rates of the tick.
            noise: Standard deviation of a measured velocity [m/s].
            valid: Whether the missed acceleration is that of the last tick.
            dt: Control tick [s].
        """
        a, v = (x.v - last.v) / dt, 0.5 * (last.v + x.v)
        thrust = u.c * so3.mul(last.R, so3.exp(0.5 * dt * u.omega))[:, 2]
        return dataclasses.replace(s, estimate=s.estimate.correct(missed, a, v, thrust, noise, valid, dt))

    def plan(
        self, s: LoadMemory, t: Float[Array, ""], lead: Float[Array, ""], dt: float
    ) -> tuple[Float[Array, "3"], LoadMemory]:
        """Return the pull at the time at which a command acts [m/s^2], and the memory with the motion of the frame.

        Args:
            s: Memory.
            t: Time of the command since the start of the flight [s].
            lead: Time from the measurement until a command acts [s].
            dt: Control tick [s].
        """
        dtype, load, sway = s.sway.p.dtype, s.estimate.load, s.sway
        coming = self.task.setpoint(t + lead.astype(t.dtype)).a.astype(dtype) + sway.a
        pull = load.after(lead, coming).pull(coming)
        a, later = (self.task.setpoint(t + soon).a.astype(dtype) for soon in (0.0, SHORT_TIME))
        rests = jnp.sum(a * a) + jnp.sum(later * later) < REST**2
        expected = self._expect(s, a, rests, dt)
        excess = (load.length * (load.rate - expected.rate)).at[2].set(0.0)
        variance = load.length**2 * (s.estimate.P[2, 2] + s.estimate.P[3, 3])
        share = jnp.minimum(1.0, load.share / LIGHT_SHARE) * HALVING_DEVIATION**2 / (HALVING_DEVIATION**2 + variance)
        a = jnp.where(rests, GAIN_AT_REST, GAIN) * share * excess
        a = a * jnp.minimum(1.0, LARGEST_ACCELERATION / jnp.sqrt(jnp.sum(a * a) + 1e-12))
        back = RETURN * jnp.sqrt(STANDARD_GRAVITY / load.length)
        a = a - 2.0 * back * sway.v - back**2 * sway.p
        after = Sway(sway.p + dt * sway.v + 0.5 * dt**2 * a, sway.v + dt * a, a)
        return pull, LoadMemory(s.estimate, expected, after)

    def _expect(self, s: LoadMemory, a: Float[Array, "3"], rests: Bool[Array, ""], dt: float) -> Load:
        """Return the expected load one tick later; ``a`` is the acceleration of the reference [m/s^2]."""
        load = s.estimate.load
        expected = dataclasses.replace(s.expected, share=load.share, length=load.length).after(dt, a)
        remains = jnp.exp(-dt * jnp.where(rests, REST_DECAY_RATE, DECAY_RATE)).astype(a.dtype)
        return dataclasses.replace(expected, n=jnp.where(rests, remains, 1.0) * expected.n, w=remains * expected.w)
