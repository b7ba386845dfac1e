"""Estimate the disturbance, which is the acceleration that the nominal model misses, from states and commands.

The filter has two states per axis: the velocity v and the disturbance d. The nominal model predicts the change in v
over a tick, the prediction of d is constant, and the measured velocity corrects both v and d,

    v <- v_predicted + (1 - z w) (v_measured - v_predicted),
    d <- d + (1 - z) (1 - w) (v_measured - v_predicted) / dt,

with the poles z and w. One of them has the time constant that a vehicle's unmodelled motors and delays allow. The
other has the bandwidth of the steady-state Kalman filter, (q / (r sqrt(dt)))^(1/2) [rad/s], for a disturbance that
wanders by q sqrt(t) and velocities with the noise r per tick. The noise r is estimated over the last second. Without
noise, z is zero, and the observer is a first-order low-pass filter of the acceleration that the model misses in each
tick.

While a command at a limit acts, the motion of the vehicle does not show the disturbance: d and r are held, and v is set
to the measured velocity. The same applies at the first measurement and after a missed tick, since the velocity change
is then not that of one tick.

Measurements that contradict each other (:mod:`retrim.estimation.consistency`) do not contain information about the
disturbance. During such a tick and the next one, d is held, and v is predicted if a frame was dropped. The more of the
last few ticks have contradictions, the faster d decays, since an estimate without measurements acts like a push. The
correction in one tick is limited, so a wrong velocity that passes all tests has little effect.
"""

import dataclasses
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..physics import so3
from ..physics.actuators import is_unsaturated
from ..physics.command_path import LONGEST_DELAY, CommandPath, CommandQueue
from ..physics.dynamics import AbstractDynamics
from ..physics.state import Command, State, where
from .consistency import Consistency
from .latency import follows

NOISE_TAU = 1.0  # [s], memory of the estimated noise
DECAY_TAU = 0.1  # [s], decay of the estimate if all of the last few ticks have contradictions
CORRECTION, SPREADS = 0.08, 6.0  # [m/s] and standard deviations of the noise: largest innovation of a tick
COAST = 0.5  # share of contradictory ticks up to which the model predicts v after a dropped frame
SECOND_DIFFERENCE = 1.954  # mean magnitude of the second difference of white noise, in standard deviations


class ObserverState(eqx.Module):
    """Memory of the observer."""

    last: State
    """State measured one tick ago."""
    t: Float[Array, ""]
    """Time of the last measurement [s]; minus infinity before the first measurement."""
    commands: CommandQueue
    """Commands of the last few ticks; the newest was issued for the tick that has just ended."""
    v: Float[Array, "3"]
    """Estimated velocity, world [m/s]."""
    d_hat: Float[Array, "3"]
    """Estimated disturbance acceleration, world [m/s^2]."""
    innovation: Float[Array, "3"]
    """Acceleration that the model missed in the last tick, from the measured velocities alone, world [m/s^2]."""
    noise: Float[Array, ""]
    """Estimated standard deviation of a measured velocity per axis [m/s]."""
    thrust: Float[Array, ""]
    """Thrust that acts at the end of the last tick, after the lag [m/s^2]."""
    consistency: Consistency


class DisturbanceObserver(eqx.Module):
    """Estimates the present disturbance as fast as noise and unmodelled dynamics allow."""

    nominal: AbstractDynamics[Any]
    tau: Float[Array, ""]
    """Smallest time constant [s]; unmodelled motors and delays must be faster."""
    limit: Float[Array, ""]
    """Largest norm of the estimate [m/s^2]."""
    wander: Float[Array, ""]
    """Standard deviation, per axis, of the change in the disturbance in a second [m/s^2]; with infinity, the noise is
    ignored."""
    path: CommandPath = eqx.field(default_factory=CommandPath.of)
    """Command path of the vehicle. Only its delay and thrust are used, since rates are measured."""
    limits: tuple[Command, Command] | None = None
    """Smallest and largest command; None if commands are not limited."""
    longest_delay: float = eqx.field(static=True, default=LONGEST_DELAY)
    """Longest delay that the memory can hold [s]."""

    def arrival(self, s: ObserverState) -> Command:
        """Return the mean command that arrived during the tick that has just ended."""
        return s.commands.arrival(self.path.delay, self.nominal.dt)

    def acting(self, s: ObserverState, x: State) -> tuple[Command, Float[Array, ""]]:
        """Return the mean thrust and the mean body rates of the tick that has just ended, and the thrust at its end.

        The body rates are those of the measured rotation, not the commanded ones.

        Args:
            s: Memory before the measurement.
            x: Measured state.
        """
        mean, thrust = self.path.thrust(s.commands, s.thrust, self.nominal.dt)
        return Command(mean, so3.log(so3.mul(s.last.R.T, x.R)) / self.nominal.dt), thrust

    def init(self, x: State) -> ObserverState:
        """Return the memory of an undisturbed vehicle that hovers at ``x``."""
        zero = jnp.zeros_like(x.p)
        hover = Command.hover(x.p.dtype)
        commands = CommandQueue.of(hover, self.nominal.dt, longest=self.longest_delay)
        never = jnp.full_like(x.p[0], -jnp.inf)
        return ObserverState(x, never, commands, x.v, zero, zero, zero[0], hover.c, Consistency.start(x))

    def __call__(self, s: ObserverState, t: Float[Array, ""], x: State) -> ObserverState:
        """Return the memory with the estimate corrected by the new measurement.

        Call the observer once per tick, then :meth:`issue` with the command of the new tick.

        Args:
            s: Memory.
            t: Time since the start of the flight [s].
            x: Measured state.
        """
        nominal, dt = self.nominal, self.nominal.dt
        u, thrust = self.acting(s, x)
        speed_change = nominal.state(nominal.step(nominal.init(s.last), u, jnp.zeros_like(x.p))).v - s.last.v
        mismatch = (x.v - s.last.v - speed_change) / dt
        noise = self._noise(s, mismatch)
        z = jnp.exp(-jnp.sqrt(self.wander * dt**1.5 / (noise + 1e-9)))
        w = jnp.maximum(jnp.exp(-dt / self.tau), z)
        prior = s.v + speed_change + dt * s.d_hat
        innovation = x.v - prior
        size = jnp.sqrt(jnp.sum(innovation * innovation) + 1e-20)
        innovation = innovation * jnp.minimum(1.0, (CORRECTION + SPREADS * noise) / size)
        d_hat = s.d_hat + (1.0 - z) * (1.0 - w) * innovation / dt
        norm = jnp.sqrt(jnp.sum(d_hat * d_hat) + 1e-12)
        d_hat = d_hat * jnp.minimum(1.0, self.limit / norm)
        t = t.astype(x.p.dtype)
        comparable = follows(t, s.t, dt)
        consistency = s.consistency.after(s.last, x, dt, comparable)
        after = ObserverState(
            x, t, s.commands, prior + (1.0 - z * w) * innovation, d_hat, mismatch, noise, thrust, consistency
        )
        confidence = jnp.exp(-dt / DECAY_TAU * consistency.doubt**2)
        decay = jnp.where(consistency.certain, 1.0, confidence).astype(x.p.dtype)
        # The model bridges a few dropped frames, since the measured velocity has the full noise. After other
        # contradictions, it does not: measurements may be later than declared, so the prediction would be for a
        # different time.
        skips = consistency.repeated | s.consistency.repeated
        coasts = comparable & skips & (consistency.doubt < COAST)
        v = jnp.where(coasts, prior, x.v)
        result = dataclasses.replace(after, v=v, d_hat=decay * s.d_hat, innovation=s.innovation, noise=s.noise)
        comparable &= consistency.certain
        if self.limits is not None:
            comparable &= is_unsaturated(self.arrival(s), self.limits)
        return where(comparable, after, result)

    def issue(self, s: ObserverState, u: Command) -> ObserverState:
        """Return the memory after the command ``u`` was issued for the tick that begins now."""
        return dataclasses.replace(s, commands=s.commands.push(u))

    def accept(self, s: ObserverState, u: Command) -> ObserverState:
        """Return the memory after the plant accepted ``u`` instead of the command that was issued last."""
        return dataclasses.replace(s, commands=s.commands.amend(u))

    def _noise(self, s: ObserverState, mismatch: Float[Array, "3"]) -> Float[Array, ""]:
        """Return the noise of the velocities, estimated from the jumps of the missed acceleration between ticks."""
        spread = jnp.mean(jnp.abs(mismatch - s.innovation)) * self.nominal.dt / SECOND_DIFFERENCE
        return s.noise + (1.0 - jnp.exp(-self.nominal.dt / NOISE_TAU)) * (spread - s.noise)
