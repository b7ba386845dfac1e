"""Excite the vehicle with small doublets of thrust and body rates until the command path is known well enough.

Each pulse train has the signs (+, -, -, +), so it leaves neither a velocity nor a displacement. The vehicle moves by a
few centimetres. By default, a policy does not excite the vehicle; the caller adds the excitation to the command.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..estimation.command_path import PathEstimate
from ..physics.state import Command

SIGNS = (1.0, -1.0, -1.0, 1.0)


class Excitation(eqx.Module):
    """Bounded additions to the command until the estimate is narrow."""

    thrust: Float[Array, ""]
    """Amplitude of the thrust pulses [m/s^2]."""
    rates: Float[Array, "3"]
    """Amplitudes of the body-rate pulses [rad/s]."""
    pulse: Float[Array, "4"]
    """Pulse lengths of thrust, roll, pitch and yaw [s]."""
    delay_margin: Float[Array, ""]
    """Sufficient half width of the 90 % interval of the delay [s]."""
    lag_margin: Float[Array, ""]
    """Sufficient half width of the 90 % interval of the rate lag, as a share of the lag."""
    gain_margin: Float[Array, ""]
    """Sufficient half width of the 90 % interval of the thrust gain, as a share of the gain."""
    longest: Float[Array, ""]
    """Time after which the excitation ends in any case [s]."""

    @classmethod
    def of(
        cls,
        *,
        thrust: float = 2.0,
        rates: tuple[float, float, float] = (1.0, 1.0, 0.6),
        delay_margin: float = 0.008,
        lag_margin: float = 0.2,
        gain_margin: float = 0.02,
        longest: float = 3.0,
    ) -> "Excitation":
        """Return the excitation; a thrust of 2 m/s^2 moves the vehicle by 3 cm.

        Args:
            thrust: Amplitude of the thrust pulses [m/s^2].
            rates: Amplitudes of the body-rate pulses [rad/s].
            delay_margin: Sufficient half width of the 90 % interval of the delay [s].
            lag_margin: Sufficient half width of the 90 % interval of the rate lag, as a share of the lag.
            gain_margin: Sufficient half width of the 90 % interval of the thrust gain, as a share of the gain.
            longest: Time after which the excitation ends in any case [s].

        Raises:
            ValueError: An amplitude is negative or a margin is not positive.
        """
        if min(thrust, *rates) < 0.0:
            raise ValueError(f"Excitation: amplitudes must not be negative, got thrust = {thrust}, rates = {rates}")
        if min(delay_margin, lag_margin, gain_margin) <= 0.0:
            raise ValueError(
                f"Excitation: margins must be positive, got {delay_margin}, {lag_margin}, {gain_margin}; "
                "set longest = 0 to disable it"
            )
        pulse = jnp.array([0.12, 0.08, 0.08, 0.10])
        margins = (jnp.array(delay_margin), jnp.array(lag_margin), jnp.array(gain_margin))
        return cls(jnp.array(thrust), jnp.array(rates), pulse, *margins, jnp.array(longest))

    def __call__(self, t: Float[Array, ""], estimate: PathEstimate) -> Command:
        """Return the addition to the command; it is zero where the estimate is narrow enough.

        Args:
            t: Time since the start of the flight [s].
            estimate: Present estimate of the command path.
        """
        t = t.astype(self.thrust.dtype)
        thrust, rates = self.wide(estimate)
        active = jnp.stack([thrust, rates, rates, rates]) & (t < self.longest)
        # Roll and pitch are half a pulse apart, so that each axis shows its own response.
        shift = jnp.array([0.0, 0.0, 0.5, 0.0])
        phase = jnp.floor(t / self.pulse + shift + 1e-3).astype(int) % len(SIGNS)
        signs = jnp.where(active, jnp.array(SIGNS)[phase], 0.0)
        return Command(self.thrust * signs[0], self.rates * signs[1:])

    def wide(self, estimate: PathEstimate) -> tuple[Bool[Array, ""], Bool[Array, ""]]:
        """Return whether the thrust estimate and the rate estimate are wider than their margins."""
        gain, lag, delay = estimate.thrust_gain, estimate.rate_lag, estimate.delay
        thrust = 0.5 * (gain.high - gain.low) > self.gain_margin * gain.mean
        rates = 0.5 * (lag.high - lag.low) > self.lag_margin * lag.mean
        return thrust, rates | (0.5 * (delay.high - delay.low) > self.delay_margin)
