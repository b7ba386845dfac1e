"""Estimate a push from the acceleration perpendicular to the thrust.

Along the thrust axis, a push and the thrust have similar effects: a vehicle that leans into a push changes the push
along this axis and its thrust together. Perpendicular to the axis, no thrust acts.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .channel import Coefficients

PUSH, DRAG = 3.0, 0.5  # standard deviations of a push [m/s^2] and of the drag [1/s] before any flight
FLOOR = 0.05  # [m/s^2], standard deviation of unmodelled effects in one reading
BIAS = 0.02  # [m/s^2], standard deviation of unmodelled effects that last
WEIGHT = 0.1  # number of readings that weigh as much as the prior of the variance
LARGEST_CORRELATION = 0.98  # largest correlation between successive residuals
GATE = 6.0  # standard deviations beyond which a residual does not count, and two successive ones show a jump
RIDGE = 1e-4  # relative error of the sums in single precision


class LateralPush(eqx.Module):
    """Sums over the accelerations perpendicular to the thrust."""

    products: Float[Array, "5 5"]
    """Sums of products of the directions of the push, the drag's direction, and the acceleration."""
    count: Float[Array, ""]
    """Sum of the weights of the readings."""
    residual: Float[Array, "2"]
    """Residuals of the last reading that counts [m/s^2]."""
    squares: Float[Array, "2"]
    """Sums of squared residuals, and of products of successive residuals [m^2/s^4]."""
    far: Bool[Array, ""]
    """Whether the last reading was beyond :data:`GATE`."""
    jumped: Bool[Array, ""]
    """Whether the push has jumped in the last tick."""

    @classmethod
    def start(cls) -> "LateralPush":
        """Return the sums before the first reading."""
        no = jnp.array(False)
        return cls(jnp.zeros((5, 5)), jnp.zeros(()), jnp.zeros(2), jnp.zeros(2), no, no)

    def observe(
        self,
        R: Float[Array, "3 3"],
        v: Float[Array, "3"],
        force: Float[Array, "3"],
        usable: Bool[Array, ""],
        keep: Float[Array, ""],
    ) -> "LateralPush":
        """Return the sums after one tick.

        Args:
            R: Mean attitude during the tick, body to world.
            v: Mean velocity during the tick, world [m/s].
            force: Mean specific force during the tick, world [m/s^2].
            usable: Whether the reading counts; otherwise only the time advances.
            keep: Remaining weight of earlier readings.
        """
        directions = R[:, :2].T
        rows = jnp.concatenate([directions, -directions @ v[:, None], directions @ force[:, None]], axis=1)
        usable &= jnp.all(jnp.isfinite(rows))
        rows = jnp.where(usable, rows, 0.0)
        residual = rows[:, -1] - rows[:, :-1] @ self.push_and_drag().mean
        far = jnp.any(jnp.abs(residual) > GATE * jnp.sqrt(self._variance()))
        jumps = usable & far & self.far
        rows = jnp.where(far & ~jumps, 0.0, rows)
        counts = usable & ~far
        keep = jnp.where(jumps, 0.0, keep)
        squares = jnp.stack([residual @ residual, residual @ self.residual])
        return LateralPush(
            keep * self.products + rows.T @ rows,
            keep * self.count + 2.0 * (counts | jumps).astype(keep.dtype),
            jnp.where(counts, residual, 0.0),
            keep * self.squares + jnp.where(counts, squares, 0.0),
            jnp.where(usable, far & ~jumps, self.far),
            jumps,
        )

    def push(self) -> Coefficients:
        """Return the distribution of the push, world [m/s^2]."""
        result = self.push_and_drag()
        return Coefficients(result.mean[:3], jnp.linalg.inv(jnp.linalg.inv(result.information)[:3, :3]))

    def push_and_drag(self) -> Coefficients:
        """Return the distribution of the push, world [m/s^2], and of the drag coefficient [1/s].

        Residuals of a push that changes are correlated in time, so they contain less information than independent ones.
        """
        correlation = self.squares[1] / jnp.maximum(self.squares[0], FLOOR**2)
        correlation = jnp.clip(correlation, 0.0, LARGEST_CORRELATION)
        variance = self._variance() * (1.0 + correlation) / (1.0 - correlation) + self.count * BIAS**2
        products = self.products / variance
        before = jnp.array([PUSH, PUSH, PUSH, DRAG], products.dtype) ** -2
        # Without the ridge, rounding errors of the sums could exceed the prior where directions and drag are alike.
        information = products[:-1, :-1] + jnp.diag(before + RIDGE * jnp.diagonal(products)[:-1])
        return Coefficients(jnp.linalg.solve(information, products[:-1, -1]), information)

    def _variance(self) -> Float[Array, ""]:
        """Return the variance of a residual; without readings, that of a push."""
        return FLOOR**2 + (self.squares[0] + WEIGHT * PUSH**2) / (self.count + WEIGHT)
