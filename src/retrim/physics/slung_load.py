"""Model a load that hangs on a cable below the centre of mass of the vehicle, taut or slack.

The cable is a stiff spring with a damper that only pulls. The frequency of the vehicle and the load against each other
along the cable is 200 rad/s, so the cable stretches by 0.3 mm under a load of 30 %, and a substep of a millisecond
resolves the jerk when a slack cable becomes taut. The tension is evaluated at the positions half a substep ahead.
Together with the vehicle's own step, this is the leapfrog method: symplectic, of second order. Within each substep, the
same force acts on the vehicle and, reversed, on the load, so that their momentum is conserved.

The load is a point without air drag, and the cable has no mass. All quantities are per mass, so one load suits every
vehicle.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .effects import ExternalEffects
from .state import STANDARD_GRAVITY, State, where

LENGTH = 0.5  # [m], default length of the cable
STIFFNESS, DAMPING = 200.0, 0.3  # [rad/s], frequency along a taut cable, and its damping ratio


class LoadState(eqx.Module):
    """Position and velocity of the load."""

    p: Float[Array, "3"]
    """Position, world [m]."""
    v: Float[Array, "3"]
    """Velocity, world [m/s]."""


class SlungLoad(eqx.Module):
    """A load on a cable, as a :class:`~retrim.physics.disturbance.StatefulDisturbance`.

    Before it is picked up, the load is held below the vehicle, at rest, at a distance of the length of the cable. After
    it is dropped, it falls.
    """

    share: Float[Array, ""]
    """Mass of the load as a share of the mass of the vehicle [-]."""
    length: Float[Array, ""]
    """Length of the cable without tension [m]."""
    picked: Float[Array, ""]
    """Time at which the load is picked up [s]; at zero, the flight starts with the load at rest on a taut cable."""
    dropped: Float[Array, ""]
    """Time at which the load is dropped [s]; infinity if it is kept."""

    def __check_init__(self) -> None:
        """Raise ``ValueError`` if share or length is not positive, or the load is dropped before it is picked up."""
        if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(self)):
            return
        if not (self.share > 0 and self.length > 0 and self.dropped > self.picked):
            raise ValueError(
                f"SlungLoad: share = {self.share} and length = {self.length} m must be positive, and picked = "
                f"{self.picked} s before dropped = {self.dropped} s"
            )

    @classmethod
    def of(
        cls, share: float, *, length: float = LENGTH, picked: float = 0.0, dropped: float = float("inf")
    ) -> "SlungLoad":
        """Return a load.

        Args:
            share: Mass of the load as a share of the mass of the vehicle [-].
            length: Length of the cable [m].
            picked: Time at which the load is picked up [s].
            dropped: Time at which the load is dropped [s].
        """
        return cls(jnp.array(share), jnp.array(length), jnp.array(picked), jnp.array(dropped))

    def __call__(self, t: Float[Array, ""], x: State) -> ExternalEffects:
        """Return the push of a load that hangs at rest while it is attached."""
        down = jnp.array([0.0, 0.0, -STANDARD_GRAVITY], dtype=x.p.dtype)
        return ExternalEffects.of(x.p.dtype, push=self._attachment(t, x.p.dtype) * self.share.astype(x.p.dtype) * down)

    def init(self, x: State) -> LoadState:
        """Return the load below the vehicle, in equilibrium if the flight starts with it."""
        dtype = x.p.dtype
        stretch = STANDARD_GRAVITY * (1.0 + self.share) / STIFFNESS**2
        hanging = (self.length + jnp.where(self.picked <= 0.0, stretch, 0.0)).astype(dtype)
        return LoadState(x.p - hanging * jnp.array([0.0, 0.0, 1.0], dtype=dtype), x.v)

    def advance(self, s: LoadState, t: Float[Array, ""], x: State, h: float) -> tuple[ExternalEffects, LoadState]:
        """Return the push of the cable on the vehicle during a substep, and the load at its end.

        Args:
            s: Load at the start of the substep.
            t: Time at the start of the substep [s].
            x: Vehicle at the start of the substep.
            h: Length of the substep [s].
        """
        dtype = x.p.dtype
        is_held = (t < self.picked) & (self.picked > 0.0)
        at_hand = LoadState(
            x.p - self.length.astype(dtype) * jnp.array([0.0, 0.0, 1.0], dtype=dtype), jnp.zeros(3, dtype)
        )
        s = where(is_held, at_hand, s)
        middle = State(x.p + 0.5 * h * x.v, x.R, x.v)
        pull = self._attachment(t, dtype) * self.tension(LoadState(s.p + 0.5 * h * s.v, s.v), middle)
        a = jnp.array([0.0, 0.0, -STANDARD_GRAVITY], dtype=dtype) - pull * direction(s, x, 0.5 * h)
        after = LoadState(s.p + h * s.v + 0.5 * h**2 * a, s.v + h * a)
        push = self.share.astype(dtype) * pull * direction(s, x, 0.5 * h)
        return ExternalEffects.of(dtype, push=push), where(is_held, at_hand, after)

    def tension(self, s: LoadState, x: State) -> Float[Array, ""]:
        """Return the tension of the cable per mass of the load [m/s^2]; a slack cable has none."""
        q = direction(s, x)
        stretch = jnp.sum((s.p - x.p) * q) - self.length.astype(x.p.dtype)
        rate = jnp.sum((s.v - x.v) * q)
        pull = (STIFFNESS**2 * stretch + 2.0 * DAMPING * STIFFNESS * rate) / (1.0 + self.share.astype(x.p.dtype))
        return jnp.where(stretch > 0.0, jnp.maximum(pull, 0.0), 0.0)

    def _attachment(self, t: Float[Array, ""], dtype: jnp.dtype) -> Float[Array, ""]:
        return jnp.where((t >= self.picked) & (t < self.dropped), 1.0, 0.0).astype(dtype)


def direction(s: LoadState, x: State, ahead: float = 0.0) -> Float[Array, "3"]:
    """Return the unit vector from the vehicle to the load.

    Args:
        s: Load.
        x: Vehicle.
        ahead: Time over which both are extrapolated with their velocities [s].
    """
    r = s.p - x.p + ahead * (s.v - x.v)
    return r / jnp.sqrt(jnp.sum(r * r) + 1e-12)


def swing_angle(s: LoadState, x: State) -> Float[Array, ""]:
    """Return the angle between the cable and the vertical [rad]."""
    q = direction(s, x)
    return jnp.arctan2(jnp.sqrt(q[0] ** 2 + q[1] ** 2), -q[2])
