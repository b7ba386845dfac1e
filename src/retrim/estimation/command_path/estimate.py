"""Represent estimates of the command path with their uncertainty."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ...physics.state import where
from .channel import PathPosterior
from .prior import LONGEST_DELAY, MOST_RINGING
from .response import damping_of, first_order_equivalent

NINETY = 1.645  # standard deviations on each side of a normal distribution that contain 90 %
DEPENDENCE = 0.5  # correlation of the commands with a part of a disturbance that no kind of noise describes
EXCITATION_SHARE = 0.6  # share of the prior deviation; a parameter with a larger deviation is not excited


class Estimate(eqx.Module):
    """Estimate of one parameter."""

    mean: Float[Array, ""]
    deviation: Float[Array, ""]
    """Standard deviation."""
    low: Float[Array, ""]
    """Lower end of the 90 % interval."""
    high: Float[Array, ""]
    """Upper end of the 90 % interval."""
    excited: Bool[Array, ""]
    """Whether the flight was informative for the parameter: the deviation is below 60 % of that of the prior."""

    def or_earlier(self, earlier: "Estimate", variance: Float[Array, ""]) -> "Estimate":
        """Return the more certain of this estimate and an earlier one.

        Args:
            earlier: Earlier estimate.
            variance: Variance of the change in the parameter since then.
        """
        growth = jnp.sqrt(1.0 + variance / earlier.deviation**2)
        low, high = (earlier.mean + growth * (end - earlier.mean) for end in (earlier.low, earlier.high))
        older = Estimate(earlier.mean, growth * earlier.deviation, low, high, earlier.excited)
        return where(self.deviation <= older.deviation, self, older)


class PathEstimate(eqx.Module):
    """Estimate of the command path."""

    delay: Estimate
    """Delay of all commands [s]."""
    rate_lag: Estimate
    """Lag of the roll and pitch rates, 2 zeta / omega_n, which is the delay in following a ramp [s]."""
    rate_damping: Estimate
    """Damping ratio zeta of the roll and pitch rates [-]; a large value means first order."""
    rate_gain: Estimate
    """Ratio of body rate to commanded body rate, for roll and pitch [-]."""
    yaw_lag: Estimate
    """Lag of the yaw rate, defined in the same way [s]."""
    yaw_gain: Estimate
    thrust_lag: Estimate
    """First-order lag of the thrust [s]."""
    thrust_gain: Estimate
    """Ratio of thrust to commanded thrust [-]."""

    def first_order(self) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """Return the delay and lag [s] of the first-order path with the most similar turning response."""
        return first_order_equivalent(self.delay.mean, self.rate_lag.mean, self.rate_damping.mean)


def normal_estimate(mean: Float[Array, ""], deviation: Float[Array, ""], before: Float[Array, ""] | float) -> Estimate:
    """Return the estimate of a parameter with a normal posterior.

    Args:
        mean: Mean of the posterior.
        deviation: Standard deviation of the posterior.
        before: Standard deviation of the prior.
    """
    reach = NINETY * deviation
    return Estimate(mean, deviation, mean - reach, mean + reach, deviation < EXCITATION_SHARE * before)


def delay_estimate(posterior: PathPosterior) -> Estimate:
    """Return the estimate of the delay [s]."""
    mean, deviation = _moments(posterior.cells[:, 0], posterior.weight)
    result = normal_estimate(mean, deviation, LONGEST_DELAY / 12.0**0.5)
    return dataclasses.replace(result, low=jnp.maximum(result.low, 0.0))


def lag_estimate(posterior: PathPosterior, before: Float[Array, ""]) -> Estimate:
    """Return the estimate of the lag [s] (log-normal posterior); ``before`` is the prior deviation of its logarithm."""
    mean, deviation = _moments(posterior.cells[:, 1], posterior.weight)
    value, reach = jnp.exp(mean + 0.5 * deviation**2), NINETY * deviation
    off = value * jnp.sqrt(jnp.expm1(deviation**2))
    return Estimate(value, off, jnp.exp(mean - reach), jnp.exp(mean + reach), deviation < EXCITATION_SHARE * before)


def damping_estimate(posterior: PathPosterior) -> Estimate:
    """Return the estimate of the damping ratio."""
    mean, deviation = _moments(posterior.cells[:, 2], posterior.weight)
    ends = jnp.clip(jnp.stack([mean, mean + NINETY * deviation, mean - NINETY * deviation]), 0.0, MOST_RINGING)
    value, low, high = damping_of(ends)
    return Estimate(
        value, (high - low) / (2.0 * NINETY), low, high, deviation < EXCITATION_SHARE * MOST_RINGING / 12.0**0.5
    )


def gain_estimate(posterior: PathPosterior, before: Float[Array, ""]) -> Estimate:
    """Return the estimate of the gain; ``before`` is its prior deviation."""
    mean, deviation = _moments(posterior.gain, posterior.weight)
    deviation = jnp.sqrt(deviation**2 + posterior.weight @ posterior.gain_variance)
    return normal_estimate(mean, deviation, before)


def closed_loop_estimate(
    gain: Estimate, share: Float[Array, ""], count: Float[Array, ""], before: Float[Array, ""]
) -> Estimate:
    """Return the estimate of a gain from commands that react to the disturbance.

    If a part of the disturbance is predictable but not described by the kind of noise, it is correlated with the
    commands and biases the gain, and more data do not reduce this bias (Ljung, System Identification, 1999, section
    13.4).

    Args:
        gain: Estimate for the kind of noise.
        share: Share of the innovations' variance that the disturbance causes.
        count: Number of measurements.
        before: Standard deviation of the prior.
    """
    return normal_estimate(gain.mean, gain.deviation * jnp.sqrt(1.0 + DEPENDENCE**2 * share * count), before)


def _moments(values: Float[Array, " cells"], weight: Float[Array, " cells"]) -> tuple[Array, Array]:
    mean = weight @ values
    return mean, jnp.sqrt(weight @ (values - mean) ** 2)
