"""Represent the commands of the last second as features that are linear in a step response.

A command that is held over each tick is a sum of steps. Its response is therefore the sum of these steps, each times
the step response at the age of that step. Ages of more than half a second are joined by linear interpolation, since the
response is smooth.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...physics.state import STANDARD_GRAVITY

SPAN = 1.2  # [s], time span of the stored commands; the response to older commands is complete
SINGLE = 12  # the spacing of ages is 1/SINGLE of the age, and at least one tick
LEVER = 0.034  # [m], difference between the thrusts of rotors per mass and angular acceleration
SATURATION = 0.1  # error of the thrust, as a share of the squared difference per thrust
LEAST_THRUST = 1.0  # [m/s^2], smallest thrust of that comparison
ACTING = 3  # commands that may act in one tick


class CommandHistory(eqx.Module):
    """Commands of the last few ticks, oldest first."""

    commands: Float[Array, "k 4"]
    """Commands [c, omega] as differences from hover [m/s^2, rad/s]."""

    @classmethod
    def at_hover(cls, dt: float) -> "CommandHistory":
        """Return the history of a vehicle that has hovered until now."""
        return cls(jnp.zeros((int(ages(dt)[-1]) + 1, 4)))

    def issue(self, u: Float[Array, "4"]) -> "CommandHistory":
        """Return the history after one more command."""
        return CommandHistory(jnp.concatenate([self.commands[1:], u[None].astype(self.commands.dtype)]))

    def replaced(self, u: Float[Array, "4"]) -> "CommandHistory":
        """Return the history with the last command replaced."""
        return CommandHistory(jnp.concatenate([self.commands[:-1], u[None].astype(self.commands.dtype)]))

    def held(self, ticks: Float[Array, ""]) -> "CommandHistory":
        """Return the history after the last command was held for ``ticks`` more ticks."""
        n = self.commands.shape[0]
        source = jnp.minimum(jnp.arange(n) + jnp.clip(ticks, 0, n).astype(int), n - 1)
        return CommandHistory(self.commands[source])

    def saturation(
        self, turning: Float[Array, "3"], delay: Float[Array, ""], lag: Float[Array, ""], dt: float
    ) -> Float[Array, ""]:
        """Return the typical error of the thrust because the rate loop turns the vehicle [m/s^2].

        The rate loop demands different thrusts of the rotors on both sides. A rotor cannot push downwards, so the
        thrust is not the commanded one if the difference is large and the thrust is small.

        Args:
            turning: Measured body rates [rad/s].
            delay: Delay of the commands [s].
            lag: Lag of the body rates [s].
            dt: Control tick [s].
        """
        last = self.commands.shape[0] - 1
        commands = self.commands[jnp.clip(last - jnp.round(delay / dt).astype(int) - jnp.arange(ACTING), 0, last)]
        demand = LEVER / lag * jnp.sqrt(jnp.sum((commands[:, 1:] - turning[None]) ** 2, axis=1))
        thrust = jnp.maximum(STANDARD_GRAVITY + commands[:, 0], LEAST_THRUST)
        error = SATURATION * jnp.max(demand**2 / thrust)
        return jnp.where(jnp.isfinite(error), error, 0.0)

    def features(self, dt: float) -> Float[Array, "4 m"]:
        """Return, for each command entry, the steps at each of the :func:`ages` and the command before these steps."""
        newest_first = self.commands[::-1]
        steps = newest_first[:-1] - newest_first[1:]
        whole = jnp.asarray(_joining(dt), dtype=steps.dtype) @ steps
        return jnp.concatenate([whole, newest_first[-1:]]).T


def ages(dt: float) -> np.ndarray:
    """Return the ages of commands at which the step response is evaluated [ticks]."""
    last, result = round(SPAN / dt), [1]
    while result[-1] < last:
        result.append(min(result[-1] + max(1, result[-1] // SINGLE), last))
    return np.array(result)


def _joining(dt: float) -> np.ndarray:
    """Return the weights of linear interpolation from all ages to :func:`ages`, (m, ticks)."""
    at = ages(dt)
    each = np.arange(1, at[-1] + 1)
    return np.stack([np.interp(each, at, row) for row in np.eye(len(at))])
