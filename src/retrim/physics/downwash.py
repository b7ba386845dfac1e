"""Model the air stream below a second vehicle as a turbulent round jet.

A few rotor spacings below a quadrotor, the streams of its rotors form one turbulent jet (Bauersfeld et al., arXiv
2403.13321). The jet has a Gaussian profile U(r) = U_c exp(-ln 2 (r / h)^2). Its half-width h grows linearly with the
distance, by 0.1 per metre (Pope, Turbulent Flows, Sec. 5.1: 0.094 to 0.102). Its momentum equals the weight of the
vehicle: pi rho U_c^2 h^2 / (2 ln 2) = m g. The half-width at the rotors follows from the velocity of the far wake,
which U_c equals there (momentum theory).
"""

import dataclasses
import math

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .effects import ExternalEffects
from .propeller import AIR_DENSITY
from .state import STANDARD_GRAVITY, State
from .vehicle import Vehicle, small

SPREAD = 0.1  # growth of the half-width per distance


class Downwash(eqx.Module):
    """The air stream below a vehicle of the same kind that hovers at a fixed place."""

    place: Float[Array, "3"]
    """Position of the second vehicle, world [m]."""
    weight: Float[Array, ""]
    """Weight of the second vehicle [N]."""
    radius: Float[Array, ""]
    """Rotor radius of the second vehicle [m]."""

    @classmethod
    def of(cls, place: Float[Array, "3"], vehicle: Vehicle | None = None) -> "Downwash":
        """Return the air stream below a vehicle.

        Args:
            place: Position of the second vehicle, world [m].
            vehicle: Kind of the second vehicle; by default the paper's small quadrotor.
        """
        kind = small() if vehicle is None else vehicle
        return cls(place, kind.mass * STANDARD_GRAVITY, kind.propeller.radius)

    def for_vehicle(self, vehicle: Vehicle) -> "Downwash":
        """Return the air stream below a vehicle of the given kind, at the same place."""
        return dataclasses.replace(self, weight=vehicle.mass * STANDARD_GRAVITY, radius=vehicle.propeller.radius)

    def __call__(self, t: Float[Array, ""], x: State) -> ExternalEffects:
        """Return the wind at the position of the vehicle; there is none above the second vehicle."""
        away = x.p - self.place.astype(x.p.dtype)
        below = jnp.maximum(-away[2], 0.0)
        speed = jet_speed(below, jnp.sum(away[:2] ** 2), self.weight, self.radius)
        down = jnp.where(away[2] < 0.0, speed, 0.0)
        return ExternalEffects.of(x.p.dtype, wind=jnp.array([0.0, 0.0, -1.0], dtype=x.p.dtype) * down)


def half_width(below: Float[Array, ""], radius: Float[Array, ""]) -> Float[Array, ""]:
    """Return the half-width of the jet [m] at a distance below the rotors [m]; ``radius`` is that of one rotor [m]."""
    return 2.0 * radius * math.sqrt(math.log(2.0)) + SPREAD * below


def jet_speed(
    below: Float[Array, ""], squared_radius: Float[Array, "*places"], weight: Float[Array, ""], radius: Float[Array, ""]
) -> Float[Array, "*places"]:
    """Return the speed of the jet [m/s].

    Args:
        below: Distance below the rotors [m].
        squared_radius: Squared distance from the axis of the jet [m^2].
        weight: Weight of the vehicle [N].
        radius: Radius of one of its four rotors [m].
    """
    h = half_width(below, radius)
    centre = jnp.sqrt(2.0 * math.log(2.0) * weight / (math.pi * AIR_DENSITY)) / h
    return centre * jnp.exp(-math.log(2.0) * squared_radius / h**2)
