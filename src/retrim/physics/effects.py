"""Combine the external effects on a vehicle at one instant: push, wind, rotor faults and load."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float


class ExternalEffects(eqx.Module):
    """External effects on a vehicle. Effects are combined by addition: ``a + b`` contains both."""

    push: Float[Array, "3"]
    """External acceleration, world [m/s^2]."""
    wind: Float[Array, "3"]
    """Air velocity at the vehicle, world [m/s]; it acts through the aerodynamics."""
    gain: Float[Array, "4"]
    """Factor that multiplies the thrust and torque of each rotor."""
    mass: Float[Array, ""]
    """Mass of a load, in addition to that of the vehicle [kg]."""
    inertia: Float[Array, "3"]
    """Diagonal of the load's inertia, in addition to that of the vehicle, body frame [kg m^2]."""
    moment: Float[Array, "3"]
    """First moment of the load, its mass times its position in the body frame [kg m]. It shifts the centre of mass, so
    that the thrust causes a torque; models without torques ignore it."""

    @classmethod
    def calm(cls, dtype: jnp.dtype) -> "ExternalEffects":
        """Return the effects of an undisturbed vehicle."""
        zero = jnp.zeros(3, dtype=dtype)
        return cls(zero, zero, jnp.ones(4, dtype=dtype), zero[0], zero, zero)

    @classmethod
    def of(
        cls,
        dtype: jnp.dtype,
        *,
        push: Float[Array, "3"] | None = None,
        wind: Float[Array, "3"] | None = None,
        gain: Float[Array, "4"] | None = None,
        mass: Float[Array, ""] | None = None,
        inertia: Float[Array, "3"] | None = None,
        moment: Float[Array, "3"] | None = None,
    ) -> "ExternalEffects":
        """Return the given effects; all others are those of an undisturbed vehicle."""
        calm = cls.calm(dtype)
        return cls(
            calm.push if push is None else push.astype(dtype),
            calm.wind if wind is None else wind.astype(dtype),
            calm.gain if gain is None else gain.astype(dtype),
            calm.mass if mass is None else mass.astype(dtype),
            calm.inertia if inertia is None else inertia.astype(dtype),
            calm.moment if moment is None else moment.astype(dtype),
        )

    def __add__(self, other: "ExternalEffects") -> "ExternalEffects":
        """Combine two effects: gains are multiplied, and all other effects are added."""
        return ExternalEffects(
            self.push + other.push,
            self.wind + other.wind,
            self.gain * other.gain,
            self.mass + other.mass,
            self.inertia + other.inertia,
            self.moment + other.moment,
        )
