"""Predict the change in an estimated disturbance from its slope.

A vehicle follows a command late, so the command should compensate the disturbance at the time at which it acts. A slope
predicts some disturbances well, for example drag along a curve, and others not at all, for example the noise of an
estimate. The share of the slope that is used is therefore the coefficient of the regression of the later change on
the earlier slope during the last seconds,

    share = E[slope(t - h) (d(t) - d(t - h)) / h] / E[slope(t - h)^2],

between 0 and 1, with the horizon h. For noise, an increase is followed by a decrease, and the share is zero.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

SPAN = 0.32  # [s], longest horizon
SMOOTHING = 0.04  # [s], time constant of the slope
MEMORY = 2.0  # [s], time constant of the means of the regression
LEAST = 0.03  # [m/s^3], rms slope at which the share is halved
LARGEST = 2.0  # largest slope that is extrapolated, as a multiple of the rms slope of the last seconds


class Trend(eqx.Module):
    """Estimates and slopes of the last ticks, and the means of the regression."""

    estimates: Float[Array, "n 3"]
    """Estimated disturbances, newest first, world [m/s^2]."""
    slopes: Float[Array, "n 3"]
    """Slopes at the same times [m/s^3]."""
    product: Float[Array, "3"]
    """Mean product of earlier slope and mean slope since then [m^2/s^6]."""
    square: Float[Array, "3"]
    """Mean square of the earlier slope [m^2/s^6]."""

    @classmethod
    def start(cls, d: Float[Array, "3"], dt: float) -> "Trend":
        """Return the memory at the start of a flight.

        Args:
            d: Estimated disturbance, world [m/s^2].
            dt: Control tick [s].
        """
        n, zero = round(SPAN / dt) + 1, jnp.zeros_like(d)
        return cls(jnp.broadcast_to(d, (n, 3)), jnp.zeros((n, 3), d.dtype), zero, zero)

    def after(self, d: Float[Array, "3"], horizon: Float[Array, "3"], dt: float) -> "Trend":
        """Return the memory after one tick.

        Args:
            d: Estimated disturbance, world [m/s^2].
            horizon: Horizon of the prediction of each component [s].
            dt: Control tick [s].
        """
        slope = self.slopes[0] + _part(dt, SMOOTHING) * ((d - self.estimates[0]) / dt - self.slopes[0])
        estimates, slopes = (
            jnp.concatenate([new[None], rows[:-1]]) for new, rows in ((d, self.estimates), (slope, self.slopes))
        )
        last = estimates.shape[0] - 1.0
        age = jnp.clip(horizon.astype(d.dtype) / dt, 1.0, last)
        weights = jnp.clip(1.0 - jnp.abs(jnp.arange(last + 1.0, dtype=d.dtype)[:, None] - age[None]), 0.0, 1.0)
        earlier = jnp.sum(weights * slopes, axis=0)
        change = (d - jnp.sum(weights * estimates, axis=0)) / (age * dt)
        product = self.product + _part(dt, MEMORY) * (earlier * change - self.product)
        square = self.square + _part(dt, MEMORY) * (earlier * earlier - self.square)
        return Trend(estimates, slopes, product, square)

    def change(self, horizon: Float[Array, "3"]) -> Float[Array, "3"]:
        """Return the predicted change in the disturbance over the ``horizon`` of each component [m/s^2]."""
        product, square = _by_direction(self.product), _by_direction(self.square)
        share = jnp.clip(product / (square + LEAST**2), 0.0, 1.0)
        slope = self.slopes[0]
        usual = jnp.minimum(1.0, LARGEST * jnp.sqrt(square / (_by_direction(slope * slope) + 1e-12)))
        return share * usual * jnp.clip(horizon.astype(slope.dtype), 0.0, SPAN) * slope


def _part(dt: float, tau: float) -> float:
    """Return the weight of a new value in a mean with the time constant ``tau``."""
    return dt / (tau + dt)


def _by_direction(mean: Float[Array, "3"]) -> Float[Array, "3"]:
    """Return the mean with equal horizontal components, since the evidence of a few seconds is small."""
    level = 0.5 * (mean[0] + mean[1])
    return jnp.stack([level, level, mean[2]])
