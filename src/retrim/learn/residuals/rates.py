"""Identify the body-rate bias and the lag of the rate loop from a window of flight.

A body-rate error is not an acceleration, so an acceleration model cannot express it. The mean rates of each tick are
compared with the commands after a first-order lag, for a grid of time constants. For each time constant, the bias has a
normal posterior. Each time constant is weighted by how well it explains the flight with this bias. The commands are
free of noise, so noisy attitudes do not make the lag appear shorter, as they would in a regression on measured rates.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from ...physics.actuators import apply_lag
from ...physics.state import Command, where
from .targets import Targets

GRID, SHORTEST, LONGEST = 32, 0.002, 1.0  # grid of time constants: number, smallest and largest [s]
SETTLING = 0.16  # [s], beginning of a window, during which the lag settles; these rows do not count


class RateFit(eqx.Module):
    """Identified bias and lag of the body rates."""

    bias: Float[Array, "3"]
    """Actual minus commanded body rates, in the body frame [rad/s]."""
    deviation: Float[Array, "3"]
    """Standard deviation of the bias [rad/s]."""
    tau: Float[Array, "3"]
    """Time constants of the lag between commanded and actual rates [s]. Roll and pitch, driven by thrust differences,
    share one time constant; yaw, driven by rotor drag, may be far slower."""


class RateModel(eqx.Module):
    """Settings of the identification; a fit takes less than a millisecond and depends on the window alone."""

    bias_prior: Float[Array, ""]
    """Standard deviation of a bias before any flight [rad/s]."""
    tau_prior: Float[Array, "3"]
    """Medians of the time constants before any flight [s]."""
    tau_spread: Float[Array, ""]
    """Standard deviation of the logarithms of the time constants."""
    noise: Float[Array, ""]
    """Smallest standard deviation of a tick's mean rate [rad/s]; for a noisier flight, the deviation is estimated."""
    memory: Float[Array, ""]
    """Age at which a row's weight is 1/e of the newest row's weight [s]."""
    dt: float = eqx.field(static=True)
    """Control tick [s]."""

    @classmethod
    def of(cls, dt: float, *, memory: float, tau: tuple[float, float, float] = (0.03,) * 3) -> "RateModel":
        """Return the model with priors for the rate loops of small quadrotors.

        Args:
            dt: Control tick [s].
            memory: Time constant of forgetting [s].
            tau: Most likely time constants of the lag of roll, pitch and yaw [s].
        """
        one = jnp.ones(())  # a fit has the same type, which avoids a recompilation after the first fit
        return cls(0.3 * one, jnp.array(tau), 0.7 * one, 0.05 * one, memory * one, dt)

    def init(self) -> RateFit:
        """Return the prior."""
        return RateFit(jnp.zeros(3), jnp.broadcast_to(self.bias_prior, (3,)), self.tau_prior)

    def fit(self, rows: Targets) -> RateFit:
        """Return the posterior given ``rows`` (newest last); return the prior if no row is valid."""
        n = rows.valid.shape[0]
        age = jnp.arange(n - 1, -1, -1, dtype=rows.omega.dtype)
        counts = rows.valid & (jnp.cumsum(rows.valid) > round(SETTLING / self.dt))
        weight = jnp.exp(-self.dt * age / self.memory) * counts.astype(age.dtype)
        taus = jnp.geomspace(SHORTEST, LONGEST, GRID, dtype=age.dtype)
        errors = rows.omega[None] - jax.vmap(lambda tau: self._follow(rows, tau))(taus)
        total = jnp.sum(weight)
        mean = jnp.einsum("n,gni->gi", weight, errors) / jnp.maximum(total, 1e-6)
        left = jnp.einsum("n,gni->gi", weight, (errors - mean[:, None]) ** 2)
        variance = jnp.maximum(self.noise**2, jnp.min(_share(left), axis=0) / jnp.maximum(total, 1.0))
        shrunk = self.bias_prior**2 / (self.bias_prior**2 + variance / jnp.maximum(total, 1e-6))
        misfit = (left + total * (1.0 - shrunk)[None] * mean**2) / variance[None]
        misfit = _share(misfit, 2.0) + (jnp.log(taus[:, None] / self.tau_prior[None]) / self.tau_spread) ** 2
        share = jax.nn.softmax(-0.5 * misfit, axis=0)
        tau = jnp.exp(jnp.sum(share * jnp.log(taus)[:, None], axis=0))
        bias, deviation = self._bias(jnp.einsum("gi,gni->ni", share, errors), weight)
        return where(total > 0.0, RateFit(bias, deviation, tau), self.init())

    def _bias(
        self, errors: Float[Array, "n 3"], weight: Float[Array, " n"]
    ) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
        """Return the posterior mean and deviation of a constant in the errors, whose noise is autoregressive.

        A swing that the lag does not explain is not a bias, and its compensation would drive the swing. Its successive
        errors are correlated, so n of them contain as much information as n (1 - rho) / (1 + rho) independent ones.
        """
        total = jnp.maximum(jnp.sum(weight), 1e-6)
        mean = weight @ errors / total
        centred = errors - mean[None]
        power = _share(weight @ centred**2)
        pairs = jnp.where(weight[:-1] > 0.0, weight[1:], 0.0)
        rho = _share(pairs @ (centred[1:] * centred[:-1])) / jnp.maximum(power, 1e-12)
        rho = (
            rho + (1.0 + 3.0 * rho) * jnp.sum(weight**2) / total**2
        )  # bias of a short window (Marriott and Pope, 1954)
        rho = jnp.clip(rho, 0.0, 0.999)
        variance = (self.noise**2 + power / total * (1.0 + rho) / (1.0 - rho)) / total
        shrunk = self.bias_prior**2 / (self.bias_prior**2 + variance)
        return shrunk * mean, jnp.sqrt((1.0 - shrunk) * self.bias_prior**2)

    def _follow(self, rows: Targets, tau: Float[Array, ""]) -> Float[Array, "n 3"]:
        """Return the mean rates of each tick if the vehicle followed the commands with a lag and without a bias."""

        def tick(acting: Command, u: Command) -> tuple[Command, Float[Array, "3"]]:
            mean, end = apply_lag(acting, u, self.dt, tau)
            return end, mean.omega

        first = jax.tree.map(lambda leaf: leaf[0], rows.u)
        return lax.scan(tick, Command(first.c, rows.omega[0]), rows.u)[1]


def _share(each: Float[Array, "*g 3"], times: float = 1.0) -> Float[Array, "*g 3"]:
    """Return ``times`` the mean of roll and pitch for both axes, since they share one lag, and yaw unchanged."""
    both = 0.5 * times * (each[..., 0] + each[..., 1])
    return jnp.stack([both, both, each[..., 2]], axis=-1)
