"""Detect a vehicle that oscillates by itself, and assume a slower vehicle until the oscillation stops.

A policy that assumes a faster vehicle than the actual one turns back too late and drives the vehicle back and forth.
The estimate of the vehicle cannot show the oscillation, since a wrong estimate may be the cause. The attitude can: the
tilt swings by many times the amount that a push, a gust or a kick causes, and does not stop. If the oscillation goes on
although the policy assumes a slower vehicle, the estimate is probably not the cause, and the policy uses it again.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..physics.path_family import PathBelief
from ..physics.state import STANDARD_GRAVITY, State
from .swings import Swings

# Size of the swings of the thrust axis, times gravity. The largest kick of the gauntlet reaches 36 for a second;
# otherwise, flights on 60 vehicles with a true belief reach 15. Self-induced oscillations stay between 45 and 145.
LARGE, FULL = 30.0, 60.0
RISE = 3.0  # [1/s], largest rate at which the level rises
MEMORY = 6.0  # [s], time constant of the level's decay; lasting caution makes the flight inaccurate
REPORT_LEVEL = 0.1  # level from which the log reports the oscillation
GAIN_SHARE = 0.5  # share by which the thrust gain may be larger than estimated
STEP = (0.5, 0.5, 0.0, 0.0)  # change of the coordinates; in `hover/any`, 25 ms of delay and a factor of 2.2 of rate lag
HIGH = 0.5  # level from which caution should end the oscillation
PATIENCE = 3.0  # [s], time in which caution ends an oscillation that is caused by a wrong estimate
REST = 6.0  # [s], time without caution after it did not end the oscillation


class Caution(eqx.Module):
    """Recent swings of the tilt, and the level of caution that follows from them."""

    swings: Swings
    level: Float[Array, ""]
    """Level from 0 (the identified vehicle) to 1 (a slower vehicle)."""
    oscillation_time: Float[Array, ""]
    """Time for which the vehicle has oscillated at a high level [s]."""
    rest: Float[Array, ""]
    """Time until the level may rise again [s]."""

    @classmethod
    def none(cls, x: State) -> "Caution":
        """Return the memory for a flight that starts in the state ``x``."""
        zero = jnp.zeros_like(x.p[0])
        return cls(Swings.none(_tilt(x)), zero, zero, zero)

    def after(self, x: State, dt: float) -> "Caution":
        """Return the memory after a measurement.

        Args:
            x: Measured state.
            dt: Control tick [s].
        """
        swings, dtype = self.swings.after(_tilt(x), dt), self.level.dtype
        rests = self.rest > 0.0
        rise = RISE * dt * jnp.clip((swings.size - LARGE) / (FULL - LARGE), 0.0, 1.0)
        level = jnp.where(rests, self.level - RISE * dt, jnp.exp(-dt / MEMORY) * self.level + rise)
        oscillates = (self.level > HIGH) & (swings.size > LARGE)
        oscillation_time = jnp.where(
            oscillates, self.oscillation_time + dt, jnp.maximum(self.oscillation_time - dt, 0.0)
        )
        has_no_effect = oscillation_time > PATIENCE
        return Caution(
            swings,
            jnp.clip(level, 0.0, 1.0).astype(dtype),
            jnp.where(has_no_effect, 0.0, oscillation_time).astype(dtype),
            jnp.where(has_no_effect, REST, jnp.maximum(self.rest - dt, 0.0)).astype(dtype),
        )

    def apply(self, belief: PathBelief) -> PathBelief:
        """Return the belief with delay and rate lag increased by the level, at most to those of the slowest vehicle."""
        step = self.level * jnp.array(STEP)
        low, high = (end + jnp.minimum(step, 1.0 - end) for end in belief.ends)
        return PathBelief.between(low, high)

    def gain(self, gain: Float[Array, ""]) -> Float[Array, ""]:
        """Return a thrust gain that grows with the level of caution, which makes the commands smaller.

        Too small a gain makes all loops stiffer. Too large a gain causes an error of a few centimetres, which the
        observer removes.

        Args:
            gain: Estimated thrust gain.
        """
        return gain * (1.0 + GAIN_SHARE * self.level.astype(gain.dtype))


def _tilt(x: State) -> Float[Array, "3"]:
    """Return the acceleration from hover thrust at this attitude, in the world frame [m/s^2]."""
    return STANDARD_GRAVITY * x.R[:, 2]
