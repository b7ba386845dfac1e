"""Estimate the command path online: delay, lags, damping and gains between commands and the vehicle's motion.

Call :meth:`PathEstimator.update` with each measurement, then :meth:`PathEstimator.issue` with the new command, and
:meth:`PathEstimator.accept` if the plant accepted a different one. For a batch of ticks, call
:meth:`PathEstimator.observe` in each and :meth:`PathEstimator.estimate_path` at the end. All arrays have fixed shapes.
"""

import dataclasses
from functools import cache
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...physics import so3
from ...physics.state import STANDARD_GRAVITY, Command, State
from ..consistency import ACCELERATION, RATE, Consistency
from ..latency import follows
from .channel import Channel, Sample
from .estimate import (
    PathEstimate,
    closed_loop_estimate,
    damping_estimate,
    delay_estimate,
    gain_estimate,
    lag_estimate,
)
from .history import CommandHistory
from .lateral import LateralPush
from .noise import DIFFERENCE, DIRECT, predictable_share
from .posterior import channel_before, path_posterior
from .prior import Prior, coefficients_before, delay_belief, full_belief
from .reading import Reading

SETTLING = 0.1  # [s], beginning of a flight, during which the thrust depends on earlier commands
DRIFT = 0.015  # [1/sqrt(s)], standard deviation of the change in the thrust gain in one second
FADING = (0.03, 0.08)  # [s], time constants with which the remaining effect of these commands fades


class Channels(NamedTuple):
    """Sums of all channels."""

    rates: Channel
    """Roll and pitch."""
    yaw: Channel
    thrust: Channel
    """Thrust from differences of velocities."""
    force: Channel
    """Thrust from accelerations."""


class PathState(eqx.Module):
    """Memory of the estimator."""

    history: CommandHistory
    x: State
    """Last measured state."""
    t: Float[Array, ""]
    """Time of the last measurement [s]; minus infinity before the first."""
    elapsed: Float[Array, ""]
    """Time since the start [s]."""
    consistency: Consistency
    channels: Channels
    lateral: LateralPush
    estimate: PathEstimate
    estimate_time: Float[Array, ""]
    """Value of ``elapsed`` at the last estimate [s]."""


class PathEstimator(eqx.Module):
    """Estimates the command path of one vehicle."""

    rates: Prior
    yaw: Prior
    thrust: Prior
    memory: Float[Array, ""]
    """Time after which the weight of a measurement is 1/e of that of the newest [s]."""
    start: tuple[Channels, PathEstimate]
    """Sums and estimate before the first measurement; a program that contains a flight does not compute them."""
    dt: float = eqx.field(static=True)
    """Control tick [s]."""

    @classmethod
    def of(cls, dt: float, *, memory: float = 6.0) -> "PathEstimator":
        """Return the estimator with priors for vehicles from 30 g to 3 kg.

        Args:
            dt: Control tick [s].
            memory: Time constant of forgetting [s].

        Raises:
            ValueError: A time is not positive.
        """
        if not (dt > 0.0 and memory > dt):
            raise ValueError(
                f"PathEstimator: 0 < dt < memory must hold, got dt = {dt}, memory = {memory}; set both in s"
            )
        result: PathEstimator = _estimator(dt, memory, jnp.zeros(()).dtype.name)
        return result

    def init(self, x: State) -> PathState:
        """Return the memory of a vehicle that has hovered until now and is measured at ``x``."""
        x = jax.tree.map(lambda leaf: leaf.astype(self.memory.dtype), x)
        zero, (channels, estimate) = jnp.zeros(()), self.start
        history, lateral = CommandHistory.at_hover(self.dt), LateralPush.start()
        return PathState(history, x, zero - jnp.inf, zero, Consistency.start(x), channels, lateral, estimate, zero)

    def update(
        self,
        s: PathState,
        t: Float[Array, ""],
        x: State,
        omega: Float[Array, "3"] | None = None,
        a: Float[Array, "3"] | None = None,
        age: Float[Array, ""] | float = 0.0,
    ) -> PathState:
        """Return the memory after a measurement, with a new estimate; for the arguments, see :meth:`observe`."""
        return self.estimate_path(self.observe(s, t, x, omega, a, age))

    def observe(
        self,
        s: PathState,
        t: Float[Array, ""],
        x: State,
        omega: Float[Array, "3"] | None = None,
        a: Float[Array, "3"] | None = None,
        age: Float[Array, ""] | float = 0.0,
    ) -> PathState:
        """Return the memory after a measurement, with an unchanged estimate.

        Args:
            s: Memory.
            t: Time since the start of the flight [s].
            x: Measured state.
            omega: Measured body rates [rad/s], without latency; None if they are not measured.
            a: Measured acceleration, the mean over the last tick, world [m/s^2]; None if it is not measured.
            age: Age of ``x`` [s].
        """
        dt, dtype = self.dt, s.elapsed.dtype
        t, age = jnp.asarray(t, dtype), jnp.asarray(age, dtype)
        x, omega, a = jax.tree.map(lambda leaf: leaf.astype(dtype), (x, omega, a))
        successive = follows(t, s.t, dt)
        consistency = s.consistency.after(s.x, x, dt, successive)
        certain = successive & consistency.certain
        missing = jnp.where(jnp.isfinite(s.t), jnp.round((t - s.t) / dt) - 1.0, 0.0)
        history = s.history.held(missing)
        features = history.features(dt)
        none, hover = jnp.zeros((4, 0), dtype), jnp.array([[1.0], [0.0], [0.0], [0.0]], dtype)
        features = jnp.concatenate([features, hover], axis=1)
        keep = jnp.exp(-dt / self.memory)

        turning = so3.log(so3.mul(s.x.R.T, x.R)) / dt
        model_error = history.saturation(turning, s.estimate.delay.mean, s.estimate.rate_lag.mean, dt)
        if omega is None:
            turn_reading = Reading(turning, certain, DIFFERENCE, age, dt)
        else:
            turn_reading = Reading(omega, jnp.all(jnp.abs(omega) < RATE), DIRECT, jnp.zeros_like(age), 0.0)
            turning = omega
        now = s.channels
        rates = now.rates.observe(features[1:3], turn_reading.sample(slice(0, 2), none[1:3]), keep, dt)
        yaw = now.yaw.observe(features[3:], turn_reading.sample(slice(2, 3), none[3:]), keep, dt)

        has_settled = certain & (s.elapsed > SETTLING)
        up = jnp.array([0.0, 0.0, STANDARD_GRAVITY], dtype)
        R, v = 0.5 * (s.x.R + x.R), 0.5 * (s.x.v + x.v)
        fading = jnp.exp(-s.elapsed / jnp.array(FADING, dtype))

        def lift(R: Float[Array, "3 3"], a: Float[Array, "3"]) -> tuple[Float[Array, "1"], Float[Array, "1 n"]]:
            """Return the acceleration along the thrust as a difference from hover, and its features."""
            axis = R[:, 2]
            other = jnp.concatenate([axis, -jnp.sum(axis * v)[None], fading])
            return jnp.sum(axis * (a + up))[None] - STANDARD_GRAVITY, other[None]

        difference = (x.v - s.x.v) / dt
        value, other = lift(R, difference)
        lift_sample = Reading(value, has_settled, DIFFERENCE, age, dt).sample(slice(0, 1), other)
        if a is None:
            lateral = s.lateral.observe(R, v, difference + up, certain, keep)
        else:
            # The accelerometer has no latency, even if the attitude does.
            turn = so3.exp(age * turning)
            R = 0.5 * (so3.mul(s.x.R, turn) + so3.mul(x.R, turn))
            is_plausible = jnp.all(jnp.abs(a) < ACCELERATION)
            lateral = s.lateral.observe(R, v, a + up, certain & is_plausible, keep)

        def observe(channel: Channel, sample: Sample) -> Channel:
            return channel.observe(
                features[:1], sample, keep, dt, jumping=3, jumped=lateral.jumped, model_error=model_error
            )

        thrust = observe(now.thrust, lift_sample)
        force = now.force
        if a is not None:
            value, other = lift(R, a)
            sample = Reading(value, has_settled & is_plausible, DIRECT, jnp.zeros_like(age), dt).sample(
                slice(0, 1), other
            )
            force = observe(force, sample)
        channels = Channels(rates, yaw, thrust, force)
        return PathState(history, x, t, s.elapsed + dt, consistency, channels, lateral, s.estimate, s.estimate_time)

    def estimate_path(self, s: PathState) -> PathState:
        """Return the memory with a new estimate."""
        channels, new = _estimate(s.channels, s.lateral, self.rates, self.yaw, self.thrust, self.dt)
        # A launch reveals the gain, but hovering in turbulence does not.
        gain = new.thrust_gain.or_earlier(s.estimate.thrust_gain, DRIFT**2 * (s.elapsed - s.estimate_time))
        estimate = dataclasses.replace(new, thrust_gain=gain)
        return dataclasses.replace(s, channels=channels, estimate=estimate, estimate_time=s.elapsed)

    def issue(self, s: PathState, u: Command) -> PathState:
        """Return the memory after the command ``u`` was issued for the tick that begins now."""
        return dataclasses.replace(s, history=s.history.issue(_from_hover(u)))

    def accept(self, s: PathState, u: Command) -> PathState:
        """Return the memory after the plant accepted ``u`` instead of the command that was issued last."""
        return dataclasses.replace(s, history=s.history.replaced(_from_hover(u)))


@cache
def _estimator(dt: float, memory: float, dtype: str) -> PathEstimator:
    """Return an estimator; compiled ahead, since a program that contains a flight should not compute the start."""

    def build(one: Float[Array, ""]) -> PathEstimator:
        no = jnp.zeros(0)
        rates = Prior(one, 0.15 * one, 0.05 * one, 1.0 * one, no, 0.03 * one, 0.003 * one, 0.0 * one, (9, 9, 5))
        yaw = Prior(one, 0.15 * one, 0.08 * one, 1.0 * one, no, 0.03 * one, 0.003 * one, 0.0 * one, (5, 7, 5))
        # Push [m/s^2], drag [1/s], and remaining effect of earlier commands [m/s^2].
        other = jnp.array([3.0, 3.0, 3.0, 0.5, 20.0, 20.0])
        thrust = Prior(
            one, 0.3 * one, 0.04 * one, 0.8 * one, other, 0.2 * one, 0.02 * one, STANDARD_GRAVITY * one, (7, 9, 1)
        )
        return PathEstimator(rates, yaw, thrust, memory * one, _start(rates, yaw, thrust, dt), dt)

    one = np.ones((), dtype)
    fast: dict[str, str | bool] = {"xla_backend_optimization_level": "0"}  # the program runs once
    result: PathEstimator = jax.jit(build).lower(one).compile(fast)(one)
    return result


def _start(rates: Prior, yaw: Prior, thrust: Prior, dt: float) -> tuple[Channels, PathEstimate]:
    """Return the sums and the estimate before the first measurement."""
    channels = Channels(
        channel_before(2, rates, dt),
        channel_before(1, yaw, dt),
        channel_before(1, thrust, dt),
        channel_before(1, thrust, dt),
    )
    return _estimate(channels, LateralPush.start(), rates, yaw, thrust, dt)


def _estimate(
    channels: Channels, lateral: LateralPush, rates: Prior, yaw: Prior, thrust: Prior, dt: float
) -> tuple[Channels, PathEstimate]:
    """Return the sums relative to a new prediction, and the estimate.

    The rates determine the delay for all channels, the accelerations provide a prior for the velocities, and the
    accelerations perpendicular to the thrust provide a prior for the push.
    """
    others = coefficients_before(thrust, lateral.push())
    of_rates = path_posterior(channels.rates, rates, None, dt)
    of_yaw = path_posterior(channels.yaw, yaw, delay_belief(of_rates, yaw), dt)
    of_force = path_posterior(channels.force, thrust, delay_belief(of_rates, thrust), dt, others)
    of_thrust = path_posterior(channels.thrust, thrust, full_belief(of_force), dt, others)
    gain = closed_loop_estimate(
        gain_estimate(of_thrust, thrust.gain_spread), *_dependence(channels), thrust.gain_spread
    )
    estimate = PathEstimate(
        delay_estimate(of_rates),
        lag_estimate(of_rates, rates.lag_spread),
        damping_estimate(of_rates),
        gain_estimate(of_rates, rates.gain_spread),
        lag_estimate(of_yaw, yaw.lag_spread),
        gain_estimate(of_yaw, yaw.gain_spread),
        lag_estimate(of_thrust, thrust.lag_spread),
        gain,
    )
    result = Channels(
        channels.rates.predict(of_rates, coefficients_before(rates)),
        channels.yaw.predict(of_yaw, coefficients_before(yaw)),
        channels.thrust.predict(of_thrust, others),
        channels.force.predict(of_force, others),
    )
    return result, estimate


def _dependence(channels: Channels) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Return the share of the disturbance in the innovations of the better sensor, and its number of measurements."""
    force, thrust = channels.force, channels.thrust
    direct, difference = (jnp.asarray(predictable_share(kinds), force.noise.dtype) for kinds in (DIRECT, DIFFERENCE))
    has_force = force.count > 0.0
    count = jnp.where(has_force, force.temper * force.count, thrust.temper * thrust.count)
    return jnp.where(has_force, direct[force.kind], difference[thrust.kind]), count


def _from_hover(u: Command) -> Float[Array, "4"]:
    return u.vector() - Command.hover(u.c.dtype).vector()
