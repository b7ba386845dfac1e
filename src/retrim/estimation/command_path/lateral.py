"""Estimate a push from the acceleration perpendicular to the thrust.

Along the thrust axis, a push and the thrust have similar effects: a vehicle that leans into a push changes the push
along this axis and its thrust together. Perpendicular to the axis, no thrust acts.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .channel import Coefficients

MEMORY = 2.0  # [s], time constant of forgetting
PUSH, DRAG = 3.0, 0.5  # standard deviations of a push [m/s^2] and of the drag [1/s] before any flight
WEIGHT = 0.1  # number of readings that weigh as much as the prior of the variance
FLOOR = 0.05  # [m/s^2], standard deviation of unmodelled effects
SLOWEST = 0.98  # largest correlation between successive residuals
GATE = 6.0  # standard deviations of two successive residuals beyond which the push has jumped


class LateralPush(eqx.Module):
    """Sums over the accelerations perpendicular to the thrust."""

    products: Float[Array, "5 5"]
    """Sums of products of the directions of the push, the drag's direction, and the acceleration."""
    count: Float[Array, ""]
    """Sum of the weights of the readings."""
    residual: Float[Array, "2"]
    """Residuals of the last tick [m/s^2]."""
    squares: Float[Array, "2"]
    """Sums of squared residuals, and of products of successive residuals [m^2/s^4]."""

    @classmethod
    def start(cls) -> "LateralPush":
        """Return the sums before the first reading."""
        return cls(jnp.zeros((5, 5)), jnp.zeros(()), jnp.zeros(2), jnp.zeros(2))

    def observe(
        self,
        R: Float[Array, "3 3"],
        v: Float[Array, "3"],
        force: Float[Array, "3"],
        usable: Bool[Array, ""],
        dt: float,
    ) -> "LateralPush":
        """Return the sums after one tick.

        Args:
            R: Mean attitude during the tick, body to world.
            v: Mean velocity during the tick, world [m/s].
            force: Mean specific force during the tick, world [m/s^2].
            usable: Whether the reading counts; otherwise only the time advances.
            dt: Control tick [s].
        """
        directions = R[:, :2].T
        rows = jnp.concatenate([directions, -directions @ v[:, None], directions @ force[:, None]], axis=1)
        usable &= jnp.all(jnp.isfinite(rows))
        rows = jnp.where(usable, rows, 0.0)
        mean, _ = self._fit()
        residual = rows[:, -1] - rows[:, :-1] @ mean
        limit = GATE * jnp.sqrt(self._variance())
        jumps = jnp.any((jnp.abs(residual) > limit) & (jnp.abs(self.residual) > limit))
        keep = jnp.where(jumps, 0.0, jnp.exp(jnp.asarray(-dt / MEMORY, v.dtype)))
        squares = keep * self.squares + jnp.stack([residual @ residual, residual @ self.residual])
        return LateralPush(
            keep * self.products + rows.T @ rows,
            keep * self.count + 2.0 * usable.astype(v.dtype),
            jnp.where(jumps, 0.0, residual),
            jnp.where(jumps, 0.0, squares),
        )

    def push(self) -> Coefficients:
        """Return the distribution of the push [m/s^2].

        Residuals of a push that changes are related in time, so they contain less information than their number.
        """
        mean, information = self._fit()
        relation = jnp.clip(self.squares[1] / jnp.maximum(self.squares[0], FLOOR**2), 0.0, SLOWEST)
        covariance = jnp.linalg.inv(information * (1.0 - relation) / (1.0 + relation))
        return Coefficients(mean[:3], jnp.linalg.inv(covariance[:3, :3]))

    def _variance(self) -> Float[Array, ""]:
        """Return the variance of a residual; without readings, that of a push."""
        return FLOOR**2 + (self.squares[0] + WEIGHT * PUSH**2) / (self.count + WEIGHT)

    def _fit(self) -> tuple[Float[Array, "4"], Float[Array, "4 4"]]:
        """Return the push and the drag coefficient, and their information for independent residuals."""
        products = self.products / self._variance()
        before = jnp.array([PUSH, PUSH, PUSH, DRAG], products.dtype) ** -2
        information = products[:-1, :-1] + jnp.diag(before)
        return jnp.linalg.solve(information, products[:-1, -1]), information
