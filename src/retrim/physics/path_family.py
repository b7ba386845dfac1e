"""Define a family of vehicles by the command paths for which one policy is trained, and the belief about a vehicle.

A policy commands mass-normalised thrust and body rates. The size, mass and inertia of a vehicle therefore affect only
its command path: the delay of a command, and the lag of thrust and rates. A path has four coordinates in [-1, 1]: the
delay, the logarithm of the rate lag, the ringing of the rate loop, and the logarithm of the thrust lag. The belief
about a vehicle is an interval for each coordinate; see :class:`PathBelief`.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax import random
from jaxtyping import Array, Float, Key

from .actuator_response import ActuatorResponse, strong_array
from .command_path import CommandPath

COORDINATES = 4
"""Number of coordinates of a path."""
Coordinates = Float[Array, "4"]
"""Delay, rate lag, ringing and thrust lag, each in [-1, 1]."""


class PathBelief(eqx.Module):
    """Intervals that contain the coordinates of a vehicle, as observed by a policy of the family."""

    centre: Coordinates
    half_width: Coordinates
    """1 for an unknown coordinate, 0 for a known one."""

    @classmethod
    def unknown(cls) -> "PathBelief":
        """Return the belief about any vehicle of the family."""
        return cls(jnp.zeros(COORDINATES), jnp.ones(COORDINATES))

    @classmethod
    def between(cls, low: Coordinates, high: Coordinates) -> "PathBelief":
        """Return the belief with the given intervals; parts outside the family are cut off.

        Args:
            low: Lower ends of the intervals.
            high: Upper ends of the intervals.
        """
        low, high = jnp.clip(low, -1.0, 1.0), jnp.clip(high, -1.0, 1.0)
        return cls(0.5 * (low + high), 0.5 * (high - low))

    def towards(self, other: "PathBelief", step: float | Float[Array, ""]) -> "PathBelief":
        """Return the belief after a move towards another belief; each end moves by at most ``step``."""
        ends = [here + jnp.clip(there - here, -step, step) for here, there in zip(self.ends, other.ends, strict=True)]
        return PathBelief.between(*ends)

    @property
    def ends(self) -> tuple[Coordinates, Coordinates]:
        """Lower and upper ends of the intervals."""
        return self.centre - self.half_width, self.centre + self.half_width

    def vector(self) -> Float[Array, "8"]:
        """Return the centres and half widths as one vector, with entries of order one."""
        return jnp.concatenate([self.centre, self.half_width])


class Member(eqx.Module):
    """One vehicle of the family, and the belief about it."""

    path: CommandPath
    belief: PathBelief
    response_time: Float[Array, ""] | None = None
    """Largest sum of delay and rate lag within the belief [s]; None outside a flight."""
    certainty: Float[Array, ""] | None = None
    """Share from 0 to 1 that decreases with the width of the belief about this sum; None outside a flight."""


class PathFamily(eqx.Module):
    """Family of vehicles, defined by the ranges of their command paths."""

    delay: Float[Array, "2"]
    """Shortest and longest delay of commands [s]."""
    rate_lag: Float[Array, "2"]
    """Smallest and largest time constant 2 zeta / omega_n of the body rates [s]."""
    ringing: Float[Array, "2"]
    """Range of 1 / (1 + 2 zeta^2): 0 is a first-order loop, 1/3 is critical damping."""
    thrust_lag: Float[Array, "2"]
    """Smallest and largest time constant of the thrust [s]."""
    least_frequency: Float[Array, ""]
    """Smallest natural frequency of a drawn rate loop [rad/s]; a slower loop is drawn with less ringing."""

    @classmethod
    def of(
        cls,
        *,
        delay: tuple[float, float] = (0.0, 0.1),
        rate_lag: tuple[float, float] = (0.01, 0.25),
        least_damping: float = 0.4,
        thrust_lag: tuple[float, float] = (0.01, 0.15),
        least_frequency: float = 4.0,
    ) -> "PathFamily":
        """Return a family.

        Args:
            delay: Shortest and longest delay of commands [s].
            rate_lag: Smallest and largest time constant of the body rates [s].
            least_damping: Smallest damping ratio of the rate loop; the largest is that of a first-order loop.
            thrust_lag: Smallest and largest time constant of the thrust [s].
            least_frequency: Smallest natural frequency of a drawn rate loop [rad/s].

        Raises:
            ValueError: A range is empty, or a lag, the damping or the frequency is not positive.
        """
        for name, (low, high) in {"delay": delay, "rate_lag": rate_lag, "thrust_lag": thrust_lag}.items():
            if not (0.0 <= low < high and (low > 0.0 or name == "delay")):
                raise ValueError(f"PathFamily: {name} must be a range of positive numbers, got {low:g} to {high:g} s")
        for name, value in {"least_damping": least_damping, "least_frequency": least_frequency}.items():
            if not value > 0.0:
                raise ValueError(f"PathFamily: {name} must be positive, got {value:g}")
        ringing = (0.0, _ringing(least_damping))
        delays, lags, rings, thrusts = (
            strong_array(jnp.array(each)) for each in (delay, rate_lag, ringing, thrust_lag)
        )
        return cls(delays, lags, rings, thrusts, strong_array(least_frequency))

    def coordinates(
        self,
        delay: Float[Array, ""],
        rate_lag: Float[Array, ""],
        ringing: Float[Array, ""],
        thrust_lag: Float[Array, ""],
    ) -> Coordinates:
        """Return the coordinates of a path, which are outside [-1, 1] for a vehicle outside the family."""
        low, high = self._ends
        tiny = 1e-6
        values = jnp.stack(
            [delay, jnp.log(jnp.maximum(rate_lag, tiny)), ringing, jnp.log(jnp.maximum(thrust_lag, tiny))]
        )
        return 2.0 * (values - low) / (high - low) - 1.0

    def path(self, at: Coordinates) -> CommandPath:
        """Return the command path at the given coordinates, with gains of one."""
        low, high = self._ends
        delay, log_lag, ringing, log_thrust = low + 0.5 * (at + 1.0) * (high - low)
        inverse_damping = jnp.sqrt(2.0 * ringing / (1.0 - ringing))
        lag, thrust_lag = jnp.exp(log_lag), jnp.exp(log_thrust)
        return CommandPath.of(delay, ActuatorResponse.of(thrust_lag, lag, inverse_damping=inverse_damping))

    def draw(self, key: Key[Array, ""]) -> Member:
        """Draw a vehicle and a true belief about it; the key is consumed.

        The vehicle is uniformly distributed within its belief, so a belief is neither too narrow nor too wide.
        Vehicles at the edges of the family and narrow beliefs are more frequent than others, because they are harder to
        fly. Half of the vehicles are known equally well in all coordinates. A rate loop below the smallest natural
        frequency rings less than its belief implies, since the vehicle could not be flown otherwise.
        """
        k_common, k_width, k_centre, k_inside = random.split(key, 4)
        common, alike = random.uniform(k_common, (2,))
        width = jnp.where(alike < 0.5, common, random.uniform(k_width, (COORDINATES,))) ** 2
        edge = jnp.sin(0.5 * jnp.pi * random.uniform(k_centre, (COORDINATES,), minval=-1.0, maxval=1.0))
        centre = (1.0 - width) * edge
        at = centre + width * random.uniform(k_inside, (COORDINATES,), minval=-1.0, maxval=1.0)
        return Member(self.path(self._within_frequency(at)), PathBelief(centre, width))

    def _within_frequency(self, at: Coordinates) -> Coordinates:
        low, high = self._ends
        lag = jnp.exp(low[1] + 0.5 * (at[1] + 1.0) * (high[1] - low[1]))
        most = 2.0 * (_ringing(0.5 * self.least_frequency * lag) - low[2]) / (high[2] - low[2]) - 1.0
        return at.at[2].min(jnp.maximum(most, -1.0))

    @property
    def _ends(self) -> tuple[Coordinates, Coordinates]:
        ends = jnp.stack([self.delay, jnp.log(self.rate_lag), self.ringing, jnp.log(self.thrust_lag)])
        return ends[:, 0], ends[:, 1]


def _ringing(damping: Any) -> Any:
    return 1.0 / (1.0 + 2.0 * damping**2)
