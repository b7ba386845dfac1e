"""External effects on a vehicle at one instant: push, wind, rotor faults, load."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float


class ExternalEffects(eqx.Module):
    """What acts on a vehicle from outside. Effects add up: ``a + b`` holds both."""

    push: Float[Array, "3"]
    """External acceleration, world [m/s^2]."""
    wind: Float[Array, "3"]
    """Velocity of the air where the vehicle is, world [m/s]; acts through the aerodynamics."""
    gain: Float[Array, "4"]
    """Multiplies thrust and torque of each rotor."""
    mass: Float[Array, ""]
    """Load, in addition to the vehicle's mass [kg]."""
    inertia: Float[Array, "3"]
    """Diagonal of the load's inertia, in addition to the vehicle's, body frame [kg m^2]."""

    @classmethod
    def calm(cls, dtype: jnp.dtype) -> "ExternalEffects":
        """Return no effect at all."""
        zero = jnp.zeros(3, dtype=dtype)
        return cls(zero, zero, jnp.ones(4, dtype=dtype), zero[0], zero)

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
    ) -> "ExternalEffects":
        """Return the given effects and no others."""
        calm = cls.calm(dtype)
        return cls(
            calm.push if push is None else push.astype(dtype),
            calm.wind if wind is None else wind.astype(dtype),
            calm.gain if gain is None else gain.astype(dtype),
            calm.mass if mass is None else mass.astype(dtype),
            calm.inertia if inertia is None else inertia.astype(dtype),
        )

    def __add__(self, other: "ExternalEffects") -> "ExternalEffects":
        """Combine two effects: gains multiply, all else adds."""
        return ExternalEffects(
            self.push + other.push,
            self.wind + other.wind,
            self.gain * other.gain,
            self.mass + other.mass,
            self.inertia + other.inertia,
        )
