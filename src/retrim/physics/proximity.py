"""Model the effects of surfaces near the rotors: ground, the edge of a table, and a ceiling.

Each rotor has its own thrust gain, so a vehicle over an edge also receives a torque. Both models state the ratio of
thrusts at equal power:

* ground: T / T_free = 1 / (1 - (R / 4 z)^2) at the height z above the surface (Cheeseman and Bennett, ARC R&M 3021);
* ceiling: T / T_free = g^(2/3) with g = 1/2 + 1/2 sqrt(1 + R^2 / (8 d^2)) at the distance d below the surface, from
  momentum theory with radial inflow through the gap (Hsiao and Chirarattananon, arXiv 1905.04632).
"""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .effects import ExternalEffects
from .state import State
from .substep import hub_places
from .vehicle import Vehicle, small

LANDING_GEAR = 0.03  # [m], distance from the plane of the rotors to the lowest point of a vehicle
NEAREST = 0.5  # smallest distance at which the models are evaluated [rotor radii]


class RotorDisks(eqx.Module):
    """Places and size of a vehicle's rotors."""

    places: Float[Array, "4 3"]
    """Hub positions in the body frame [m]."""
    radius: Float[Array, ""]
    """Radius of a rotor [m]."""

    @classmethod
    def of(cls, vehicle: Vehicle) -> "RotorDisks":
        """Return the rotors of a vehicle."""
        return cls(hub_places(vehicle.arm), vehicle.propeller.radius)

    def hubs(self, x: State) -> Float[Array, "4 3"]:
        """Return the hub positions in the world frame [m]."""
        return x.p[None] + self.places.astype(x.p.dtype) @ x.R.T


class TableEdge(eqx.Module):
    """Ground effect over a floor at height 0 and over a table that covers all places with x beyond an edge."""

    top: Float[Array, ""]
    """Height of the table [m]."""
    edge: Float[Array, ""]
    """World x coordinate of the edge [m]; infinity for a floor without a table."""
    rotors: RotorDisks

    @classmethod
    def of(cls, top: float, edge: float, vehicle: Vehicle | None = None) -> "TableEdge":
        """Return the effect of a table.

        Args:
            top: Height of the table [m].
            edge: World x coordinate of the edge [m].
            vehicle: Vehicle with the rotors; by default the paper's small quadrotor.
        """
        return cls(jnp.array(top), jnp.array(edge), RotorDisks.of(small() if vehicle is None else vehicle))

    def for_vehicle(self, vehicle: Vehicle) -> "TableEdge":
        """Return the same surfaces for the rotors of a vehicle."""
        return dataclasses.replace(self, rotors=RotorDisks.of(vehicle))

    def __call__(self, t: Float[Array, ""], x: State) -> ExternalEffects:
        """Return the gain of each rotor; a disk over the edge has the mean gain of its two parts, by width."""
        hubs, radius = self.rotors.hubs(x), self.rotors.radius.astype(x.p.dtype)
        inside = jnp.clip((hubs[:, 0] - self.edge) / (2.0 * radius) + 0.5, 0.0, 1.0)
        share = inside * inside * (3.0 - 2.0 * inside)
        over_table, over_floor = (ground_gain(hubs[:, 2] - height, radius) for height in (self.top, 0.0))
        return ExternalEffects.of(x.p.dtype, gain=share * over_table + (1.0 - share) * over_floor)

    def clearance(self, x: State) -> Float[Array, ""]:
        """Return the distance from the lowest point of the vehicle to the surface below its centre [m]."""
        height = jnp.where(x.p[0] > self.edge, self.top, 0.0)
        return x.p[2] - LANDING_GEAR - height


class Ceiling(eqx.Module):
    """Ceiling effect under a horizontal surface."""

    height: Float[Array, ""]
    """Height of the ceiling [m]."""
    rotors: RotorDisks

    @classmethod
    def of(cls, height: float, vehicle: Vehicle | None = None) -> "Ceiling":
        """Return the effect of a ceiling.

        Args:
            height: Height of the ceiling [m].
            vehicle: Vehicle with the rotors; by default the paper's small quadrotor.
        """
        return cls(jnp.array(height), RotorDisks.of(small() if vehicle is None else vehicle))

    def for_vehicle(self, vehicle: Vehicle) -> "Ceiling":
        """Return the same ceiling for the rotors of a vehicle."""
        return dataclasses.replace(self, rotors=RotorDisks.of(vehicle))

    def __call__(self, t: Float[Array, ""], x: State) -> ExternalEffects:
        """Return the gain of each rotor."""
        distance = self.height - self.rotors.hubs(x)[:, 2]
        return ExternalEffects.of(x.p.dtype, gain=ceiling_gain(distance, self.rotors.radius.astype(x.p.dtype)))


def ground_gain(height: Float[Array, "*rotors"], radius: Float[Array, ""]) -> Float[Array, "*rotors"]:
    """Return the thrust ratio of rotors at a height above a surface, T / T_free = 1 / (1 - (R / 4 z)^2).

    Args:
        height: Height of the rotor above the surface [m].
        radius: Radius of the rotor [m].
    """
    z = jnp.maximum(height, NEAREST * radius)
    return 1.0 / (1.0 - (radius / (4.0 * z)) ** 2)


def ceiling_gain(distance: Float[Array, "*rotors"], radius: Float[Array, ""]) -> Float[Array, "*rotors"]:
    """Return the thrust ratio of rotors at a distance below a ceiling, by momentum theory.

    Args:
        distance: Distance of the rotor below the surface [m].
        radius: Radius of the rotor [m].
    """
    d = jnp.maximum(distance, NEAREST * radius)
    return (0.5 + 0.5 * jnp.sqrt(1.0 + radius**2 / (8.0 * d**2))) ** (2.0 / 3.0)
