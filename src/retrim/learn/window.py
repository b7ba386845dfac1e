"""The last few seconds of a flight, as input for the learners."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..physics.state import Command, State


class Window(eqx.Module):
    """The last ``n`` ticks of a flight, oldest first. While the window fills, ``valid`` is false for the first rows."""

    t: Float[Array, " n"]
    """Time of each tick since the start of the flight [s]."""
    x: State
    """Measured state at each tick (leading axis n)."""
    u: Command
    """Command that the plant accepted at each tick (leading axis n)."""
    valid: Bool[Array, " n"]
    age: Float[Array, " n"] | None = None
    """Age of each measurement [s]; None if all ages are zero."""

    @classmethod
    def of(
        cls,
        t: Float[Array | np.ndarray, " n"],
        p: Float[Array | np.ndarray, "n 3"],
        R: Float[Array | np.ndarray, "n 3 3"],
        v: Float[Array | np.ndarray, "n 3"],
        c: Float[Array | np.ndarray, " n"],
        omega: Float[Array | np.ndarray, "n 3"],
    ) -> "Window":
        """Build a window from the columns of a flight log.

        Args:
            t: Times, increasing [s].
            p: Positions, world [m].
            R: Attitudes, body to world.
            v: Velocities, world [m/s].
            c: Collective thrust commands, mass-normalised [m/s^2].
            omega: Body rate commands [rad/s].

        Returns:
            A window in which every tick is valid.
        """
        states = jax.vmap(State)(jnp.asarray(p), jnp.asarray(R), jnp.asarray(v))
        commands = jax.vmap(Command)(jnp.asarray(c), jnp.asarray(omega))
        return cls(jnp.asarray(t), states, commands, jnp.ones(len(t), dtype=bool))
