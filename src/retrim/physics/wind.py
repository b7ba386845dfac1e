"""Model steady wind, Dryden gusts and the jet of a fan.

Wind acts through the relative air velocity at the rotors and the body.
"""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import random
from jaxtyping import Array, Float, Key

from .effects import ExternalEffects
from .state import State

FEET = 0.3048  # [m]


class SteadyWind(eqx.Module):
    """A wind that is constant in time and space."""

    wind: Float[Array, "3"]
    """Wind velocity, world [m/s]."""

    def __call__(self, t: Float[Array, ""], x: State) -> ExternalEffects:
        """Return the wind."""
        return ExternalEffects.of(x.p.dtype, wind=self.wind)


class Turbulence(eqx.Module):
    """Gusts with Dryden's spectra as a sum of sinusoids of equal energy (spectral representation).

    The first axis is along the mean wind and has the longitudinal spectrum; the others have the transverse one.
    """

    rate: Float[Array, "n 3"]
    """Angular frequency of each sinusoid [rad/s]."""
    phase: Float[Array, "n 3"]
    sigma: Float[Array, "3"]
    """Standard deviation per axis [m/s]."""

    @classmethod
    def of(
        cls,
        speed: Float[Array, ""],
        length: Float[Array, "3"],
        sigma: Float[Array, "3"],
        *,
        key: Key[Array, ""],
        n: int = 64,
    ) -> "Turbulence":
        """Draw frozen eddies with the scale ``length`` [m] that pass at ``speed`` [m/s].

        The frequency of sinusoid k is from the k-th n-quantile of the spectrum, so all sinusoids carry the same energy.
        With s = L omega / V, the share of the energy below s is 2 atan(s) / pi along the wind, and
        (2 atan(s) - s / (1 + s^2)) / pi across it (MIL-F-8785C).
        """
        rate, phase = _eddies(speed, length, key, n)
        return cls(rate, phase, sigma)

    def __call__(self, t: Float[Array, ""]) -> Float[Array, "3"]:
        """Return the gust at ``t``: components along, across and up [m/s]."""
        n = self.rate.shape[0]
        amplitude = self.sigma * math.sqrt(2.0 / n)
        return amplitude * jnp.sum(jnp.cos(self.rate * t + self.phase), axis=0)


@eqx.filter_jit
def _eddies(
    speed: Float[Array, ""], length: Float[Array, "3"], key: Key[Array, ""], n: int
) -> tuple[Float[Array, "n 3"], Float[Array, "n 3"]]:
    """Return the rate [rad/s] and phase of each sinusoid."""
    k_quantile, k_phase = random.split(key)
    share = (jnp.arange(n, dtype=float)[:, None] + random.uniform(k_quantile, (n, 3))) / n
    grid = jnp.tan(jnp.linspace(0.0, 1.0, 2001)[:-1] * jnp.pi / 2)
    across = (2.0 * jnp.arctan(grid) - grid / (1.0 + grid**2)) / jnp.pi
    s = jnp.stack([jnp.tan(share[:, 0] * jnp.pi / 2), *(jnp.interp(share[:, i], across, grid) for i in (1, 2))], axis=1)
    fastest = 200.0  # [rad/s], limit of the resolution of a millisecond step
    rate = jnp.minimum(s * speed / length[None], fastest)
    return rate, 2.0 * jnp.pi * random.uniform(k_phase, (n, 3))


def axes_along(direction: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Return a matrix whose rows point along ``direction`` (not vertical), across it horizontally, and up."""
    along = direction / jnp.linalg.norm(direction)
    across = jnp.cross(jnp.array([0.0, 0.0, 1.0], dtype=along.dtype), along)
    across = across / jnp.linalg.norm(across)
    return jnp.stack([along, across, jnp.cross(along, across)])


class Dryden(eqx.Module):
    """A mean wind with Dryden gusts from the low-altitude model (MIL-F-8785C)."""

    mean: Float[Array, "3"]
    """Mean wind velocity, world [m/s]."""
    turbulence: Turbulence

    @classmethod
    def of(cls, mean: Float[Array, "3"], *, key: Key[Array, ""], altitude: float = 10.0 * FEET) -> "Dryden":
        """Draw the gusts of a horizontal mean wind at an ``altitude`` of at least 3.048 m.

        sigma_w is 0.1 times the wind speed at 20 ft, here that of ``mean``. The lengths and the other sigmas depend on
        the altitude in feet.
        """
        speed = float(jnp.linalg.norm(mean))
        if not speed > 0 or float(mean[2]) != 0.0 or altitude < 10.0 * FEET - 1e-9:
            raise ValueError(
                f"Dryden: mean = {mean} must be horizontal and not zero, altitude = {altitude} m at least {10 * FEET}"
            )
        h = altitude / FEET
        shape = 0.177 + 0.000823 * h
        up, level = 0.1 * speed, 0.1 * speed / shape**0.4
        scale = FEET * h / shape**1.2
        length, sigma = jnp.array([scale, scale, FEET * h]), jnp.array([level, level, up])
        return cls(mean, Turbulence.of(jnp.array(speed), length, sigma, key=key))

    def __call__(self, t: Float[Array, ""], x: State) -> ExternalEffects:
        """Return the wind, mean plus gust, at time ``t``."""
        return ExternalEffects.of(x.p.dtype, wind=self.mean + self.turbulence(t) @ axes_along(self.mean))


class Fan(eqx.Module):
    """A round, turbulent jet; its force depends on the vehicle's position, attitude and velocity.

    Far from the outlet, a jet widens in proportion to the distance. Its momentum flux is constant, so speed times
    width is constant. The profile across the jet is a Gaussian.
    """

    outlet: Float[Array, "3"]
    """Position of the outlet, world [m]."""
    direction: Float[Array, "3"]
    """Direction of the jet; not vertical."""
    speed: Float[Array, ""]
    """Speed at the outlet, on the axis [m/s]."""
    width: Float[Array, ""]
    """Standard deviation of the profile at the outlet [m]."""
    turbulence: Turbulence
    """Turbulence relative to the speed of the jet at the vehicle [-]."""

    SPREAD = 0.1  # growth of the width per metre, for free round jets

    @classmethod
    def of(
        cls,
        outlet: Float[Array, "3"],
        direction: Float[Array, "3"],
        *,
        speed: float,
        width: float,
        key: Key[Array, ""],
        intensity: float = 0.15,
    ) -> "Fan":
        """Draw a jet with gusts of ``intensity`` times its speed and eddies as wide as the outlet."""
        if not (speed > 0 and width > 0 and 0 <= intensity < 1) or float(jnp.linalg.norm(direction[:2])) == 0.0:
            raise ValueError(
                "Fan: speed and width must be positive, intensity from 0 to 1, and direction not vertical, got "
                f"speed = {speed}, width = {width}, intensity = {intensity}, direction = {direction}"
            )
        eddies = Turbulence.of(jnp.array(speed), jnp.full(3, 2.0 * width), jnp.full(3, intensity), key=key)
        return cls(outlet, direction, jnp.array(speed), jnp.array(width), eddies)

    def __call__(self, t: Float[Array, ""], x: State) -> ExternalEffects:
        """Return the wind of the jet at the vehicle's position."""
        axes = axes_along(self.direction)
        along, *off = axes @ (x.p - self.outlet)
        width = self.width + self.SPREAD * jnp.maximum(along, 0.0)
        inside = jax.nn.sigmoid(along / (0.2 * self.width) + 5.0)  # no jet behind the fan
        local = self.speed * self.width / width * jnp.exp(-0.5 * (off[0] ** 2 + off[1] ** 2) / width**2) * inside
        still = jnp.array([1.0, 0.0, 0.0], dtype=x.p.dtype)
        return ExternalEffects.of(x.p.dtype, wind=local * (still + self.turbulence(t)) @ axes)
