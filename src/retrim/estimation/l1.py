"""Estimate a disturbance by L1 adaptation: a velocity predictor, an adaptation law held over a tick, and a filter.

The predicted velocity v_hat follows the measured velocity v at the speed of the pole A_s < 0. The law selects the sigma
that would remove the whole prediction error within a tick, and the filter computes the estimate from sigma,

    v_hat <- v_hat + dt (g + f - sigma + A_s (v_hat - v)),
    sigma <- exp(A_s dt) phi^-1 (v_hat - v),   phi = (exp(A_s dt) - 1) / A_s,
    d_hat <- alpha d_hat - (1 - alpha) sigma,

where f is the commanded thrust (Hovakimyan and Cao 2010; as in DATT, Huang et al. 2023). A constant disturbance d
appears in -sigma from the second tick on, so d_hat approaches d with the time constant -dt / ln(alpha). At the
first measurement, and after a missed tick, the predictor starts from the measured velocity and d_hat is held, since the
velocity change is then not that of one tick.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..physics.state import STANDARD_GRAVITY, State, where
from .latency import follows


class L1State(eqx.Module):
    """Memory of the estimator; all vectors are in the world frame."""

    v_hat: Float[Array, "3"]
    """Predicted velocity [m/s]."""
    sigma: Float[Array, "3"]
    """Correction in the last tick [m/s^2]."""
    d_hat: Float[Array, "3"]
    """Estimated disturbance [m/s^2]."""
    t: Float[Array, ""]
    """Time of the last measurement [s]; minus infinity before the first."""

    @classmethod
    def start(cls, x: State) -> "L1State":
        """Return the memory at the start of a flight in the state ``x``."""
        return cls(x.v, jnp.zeros_like(x.v), jnp.zeros_like(x.v), jnp.full_like(x.v[0], -jnp.inf))


class L1Estimator(eqx.Module):
    """Estimates the acting disturbance from velocities and commanded thrust."""

    pole: Float[Array, ""]
    """Pole A_s of the predictor [1/s]; negative."""
    alpha: Float[Array, ""]
    """Share of the old estimate that is kept in a tick, 0 to 1."""
    dt: float = eqx.field(static=True)
    """Control tick [s]."""

    def __call__(self, s: L1State, t: Float[Array, ""], x: State, thrust: Float[Array, "3"]) -> L1State:
        """Return the memory after a tick.

        Args:
            s: Memory.
            t: Time since the start of the flight [s].
            x: State measured at the end of the tick.
            thrust: Mass-normalised thrust that acted over the tick, world [m/s^2].
        """
        dtype = x.v.dtype
        pole, alpha = self.pole.astype(dtype), self.alpha.astype(dtype)
        gravity = jnp.array([0.0, 0.0, -STANDARD_GRAVITY], dtype=dtype)
        decay = jnp.exp(pole * self.dt)
        # Predict over the tick that has ended, from the error at its beginning, from which sigma was computed.
        error = s.sigma * jnp.expm1(pole * self.dt) / pole / decay
        v_hat = s.v_hat + self.dt * (gravity + thrust - s.sigma + pole * error)
        sigma = decay * pole / jnp.expm1(pole * self.dt) * (v_hat - x.v)
        t = t.astype(dtype)
        after = L1State(v_hat, sigma, alpha * s.d_hat - (1.0 - alpha) * sigma, t)
        return where(follows(t, s.t, self.dt), after, L1State(x.v, jnp.zeros_like(x.v), s.d_hat, t))
