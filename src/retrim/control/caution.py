"""Detect a vehicle that oscillates by itself, and assume a slower vehicle until the oscillation stops.

A policy that assumes a faster vehicle than the actual one turns back too late and drives the vehicle back and forth.
The estimate of the vehicle cannot show the oscillation, since a wrong estimate may be the cause. The attitude can: the
tilt swings by many times the amount that a push, a gust or a kick causes, and does not stop.
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
CAUTIOUS_COORDINATES = (1.0, 1.0, 0.0, 0.0)  # coordinates that the level changes: delay and rate lag


class Caution(eqx.Module):
    """Recent swings of the tilt, and the level of caution that follows from them."""

    swings: Swings
    level: Float[Array, ""]
    """Level from 0 (the identified vehicle) to 1 (the slowest vehicle of the family)."""

    @classmethod
    def none(cls, x: State) -> "Caution":
        """Return the memory for a flight that starts in the state ``x``."""
        return cls(Swings.none(_tilt(x)), jnp.zeros_like(x.p[0]))

    def after(self, x: State, dt: float) -> "Caution":
        """Return the memory after a measurement.

        Args:
            x: Measured state.
            dt: Control tick [s].
        """
        swings = self.swings.after(_tilt(x), dt)
        rise = RISE * dt * jnp.clip((swings.size - LARGE) / (FULL - LARGE), 0.0, 1.0)
        level = jnp.exp(-dt / MEMORY) * self.level + rise
        return Caution(swings, jnp.minimum(level, 1.0).astype(self.level.dtype))

    def apply(self, belief: PathBelief) -> PathBelief:
        """Return the belief with delay and rate lag moved towards the slowest vehicle by the level of caution."""
        share = self.level * jnp.array(CAUTIOUS_COORDINATES)
        low, high = (end + share * (1.0 - end) for end in belief.ends)
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
