"""A constant disturbance is gravity tilted and scaled: fly the unchanged controller in the frame of that gravity.

With g' = g + d_hat, let Q be the smallest rotation that takes -g'/|g'| to the vertical. If p, R, v obey Eq. (1) with
the disturbance d_hat, then Q p, Q R, Q v obey Eq. (1) with a gravity of |g'| along -z and no disturbance: the equation
is equivariant under rotations, and d_hat enters as gravity does. What is left is the difference of the two magnitudes,
which is added to the thrust. A controller for hover therefore needs no other input to hold its goal under a constant
push.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..estimation.disturbance_observer import DisturbanceObserver, ObserverState
from ..physics import so3
from ..physics.state import STANDARD_GRAVITY, Command, State
from .controller import AbstractController


class GravityFrameState(eqx.Module):
    """Memory of the observer and of the controller inside."""

    observer: ObserverState
    inner: Any


class GravityFrame(AbstractController[GravityFrameState]):
    """Any controller of a state and a fixed goal, flown in the gravity that a disturbance observer estimates."""

    inner: AbstractController[Any]
    observer: DisturbanceObserver
    pivot: Float[Array, "3"]
    """The goal: the frame is turned about it, world [m]."""

    def init(self, x: State) -> GravityFrameState:
        """Return the memory at the start of a flight."""
        return GravityFrameState(self.observer.init(x), self.inner.init(x))

    def __call__(self, memory: GravityFrameState, t: Float[Array, ""], x: State) -> tuple[Command, GravityFrameState]:
        """Return the inner controller's command in the estimated gravity, with corrected thrust."""
        observed = self.observer(memory.observer, x)
        Q, extra = tilted(observed.d_hat)
        u, inner = self.inner(memory.inner, t, turned(Q, self.pivot, x))
        u = Command(u.c + extra, u.omega)
        return u, GravityFrameState(self.observer.issued(observed, u), inner)

    def accepted(self, memory: GravityFrameState, u: Command) -> GravityFrameState:
        """Remember the accepted command, in the observer and, less the correction, in the controller inside."""
        _, extra = tilted(memory.observer.d_hat)
        observer = self.observer.accepted(memory.observer, u)
        return GravityFrameState(observer, self.inner.accepted(memory.inner, Command(u.c - extra, u.omega)))


def tilted(d_hat: Float[Array, "3"]) -> tuple[Float[Array, "3 3"], Float[Array, ""]]:
    """Return the rotation into the frame of g + ``d_hat`` [m/s^2], and how much stronger gravity is there [m/s^2].

    Defined for every ``d_hat`` whose vertical part is smaller than gravity; a weightless vehicle has no such frame.
    """
    up = -d_hat + jnp.array([0.0, 0.0, STANDARD_GRAVITY], dtype=d_hat.dtype)
    strength = jnp.sqrt(jnp.sum(up * up))
    a, b, c = up / strength
    # Rodrigues' formula for the smallest rotation that takes (a, b, c) to (0, 0, 1).
    k = 1.0 / (1.0 + c)
    Q = jnp.stack(
        [
            jnp.stack([1.0 - k * a * a, -k * a * b, -a]),
            jnp.stack([-k * a * b, 1.0 - k * b * b, -b]),
            jnp.stack([a, b, c]),
        ]
    )
    return Q, strength - STANDARD_GRAVITY


def turned(Q: Float[Array, "3 3"], pivot: Float[Array, "3"], x: State) -> State:
    """Return the state ``x`` turned by ``Q`` about ``pivot``, world [m]."""
    return State(pivot + so3.act(Q, x.p - pivot), so3.mul(Q, x.R), so3.act(Q, x.v))
