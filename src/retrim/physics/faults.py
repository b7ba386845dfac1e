"""Model faults of the vehicle itself: a load, a sagging battery or a weak rotor."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .effects import ExternalEffects
from .state import State
from .vehicle import payload_inertia


class Payload(eqx.Module):
    """A load that is picked up and later dropped; the flight controller does not take it into account."""

    mass: Float[Array, ""]
    """Mass of the load [kg]."""
    inertia: Float[Array, "3"]
    """Diagonal of the added inertia [kg m^2]."""
    picked: Float[Array, ""]
    """Time at which the load is picked up [s]."""
    dropped: Float[Array, ""]
    """Time at which the load is dropped [s]; infinity if it is kept."""
    ahead: Float[Array, ""] = eqx.field(default_factory=lambda: jnp.array(0.0))
    """Distance of the load from the centre of the vehicle along body x [m]; it shifts the centre of mass."""

    def __check_init__(self) -> None:
        """Raise ``ValueError`` if the mass is not positive, or the load is dropped before it is picked up."""
        if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(self)):
            return
        if not self.mass > 0 or not self.dropped > self.picked:
            raise ValueError(f"Payload: mass = {self.mass} kg, picked = {self.picked} s, dropped = {self.dropped} s")

    @classmethod
    def of(cls, mass: float, *, picked: float = 0.0, dropped: float = float("inf"), ahead: float = 0.0) -> "Payload":
        """Return a load in the form of a small cube under the vehicle; see :func:`payload_inertia`.

        Args:
            mass: Mass of the load [kg].
            picked: Time at which the load is picked up [s].
            dropped: Time at which the load is dropped [s].
            ahead: Distance of the load from the centre along body x [m].
        """
        inertia = payload_inertia(mass, ahead=ahead)
        return cls(jnp.array(mass), inertia, jnp.array(picked), jnp.array(dropped), jnp.array(ahead))

    def __call__(self, t: Float[Array, ""], x: State) -> ExternalEffects:
        """Return the payload's mass, inertia and first moment while it is attached."""
        is_carried = jnp.where((t >= self.picked) & (t < self.dropped), 1.0, 0.0).astype(self.mass.dtype)
        moment = is_carried * self.mass * self.ahead * jnp.array([1.0, 0.0, 0.0], dtype=self.mass.dtype)
        return ExternalEffects.of(
            x.p.dtype, mass=is_carried * self.mass, inertia=is_carried * self.inertia, moment=moment
        )


class BatterySag(eqx.Module):
    """A sagging battery: the thrust decreases at a constant rate down to a floor."""

    rate: Float[Array, ""]
    """Share of the thrust lost per second [1/s]."""
    floor: Float[Array, ""]
    """Smallest share of the thrust that remains."""

    def __check_init__(self) -> None:
        """Raise ``ValueError`` if the rate is negative or the floor is not between 0 and 1."""
        if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(self)):
            return
        if not self.rate >= 0 or not 0 < self.floor <= 1:
            raise ValueError(f"BatterySag: rate = {self.rate} 1/s, floor = {self.floor}")

    def __call__(self, t: Float[Array, ""], x: State) -> ExternalEffects:
        """Return the gain of all rotors at time ``t``."""
        share = jnp.maximum(1.0 - self.rate * t, self.floor)
        return ExternalEffects.of(x.p.dtype, gain=share * jnp.ones(4, dtype=share.dtype))


class WeakRotor(eqx.Module):
    """One rotor with reduced thrust and torque at a given speed, e.g. because of a chipped propeller."""

    gain: Float[Array, "4"]
    """Gains of the rotors: front-right, back-left, back-right, front-left."""

    @classmethod
    def of(cls, rotor: int, share: float) -> "WeakRotor":
        """Return a fault of rotor number ``rotor`` (0 to 3), which keeps ``share`` of its thrust."""
        if rotor not in range(4) or not 0 < share <= 1:
            raise ValueError(f"WeakRotor: rotor = {rotor} must be 0 to 3, share = {share} in (0, 1]")
        return cls(jnp.ones(4).at[rotor].set(share))

    def __call__(self, t: Float[Array, ""], x: State) -> ExternalEffects:
        """Return the gains of the rotors."""
        return ExternalEffects.of(x.p.dtype, gain=self.gain)
