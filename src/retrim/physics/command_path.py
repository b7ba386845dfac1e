"""Model the command path of a vehicle, from the controller to the motion.

A command acts after a transport delay. Thrust and body rates then follow it with the response of
:class:`~retrim.physics.actuator_response.ActuatorResponse`. Commands wait in a queue of fixed length, so a
different delay does not require recompilation.
"""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from .actuator_response import ActuatorResponse, ActuatorState, strong_array
from .state import Command

LONGEST_DELAY = 0.2  # [s], default for the longest delay that a queue can hold
ROUNDING = 1e-4  # steps; a delay this close to a whole number of steps counts as whole


class CommandQueue(eqx.Module):
    """The commands of the last few ticks, in a queue of fixed length."""

    commands: Command
    """Commands along the leading axis, oldest first; each was held for one tick."""

    @classmethod
    def of(cls, u: Command, dt: float, *, longest: float = LONGEST_DELAY) -> "CommandQueue":
        """Return the queue of a controller that has always commanded ``u``.

        Args:
            u: Command.
            dt: Control tick [s].
            longest: Longest delay that the queue can hold [s].
        """
        n = queue_length(dt, longest)
        return cls(jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (n, *leaf.shape)), u))

    def push(self, u: Command) -> "CommandQueue":
        """Return the queue after the command ``u`` was issued for the tick that begins now."""
        rows = jax.tree.map(lambda old, new: jnp.concatenate([old[1:], new[None]]), self.commands, u)
        return CommandQueue(rows)

    @property
    def newest(self) -> Command:
        """Last issued command."""
        return jax.tree.map(lambda leaf: leaf[-1], self.commands)  # type: ignore[no-any-return]

    def amend(self, u: Command) -> "CommandQueue":
        """Return the queue with ``u`` instead of the last issued command."""
        rows = jax.tree.map(lambda old, new: jnp.concatenate([old[:-1], new[None]]), self.commands, u)
        return CommandQueue(rows)

    def arrival(self, delay: Float[Array, ""], dt: float) -> Command:
        """Return the mean command that arrives during the tick that begins now.

        The result is a weighted mean of two neighbouring commands in the queue.

        Args:
            delay: Transport delay [s], at most the longest that the queue can hold.
            dt: Control tick [s].
        """
        return self.combine(self.weights(delay, dt))

    def pieces(self, delay: Float[Array, ""], dt: float) -> tuple[Command, Command, Float[Array, ""]]:
        """Return the two commands that arrive in the tick that begins now, and the time of the change between them [s].

        Args:
            delay: Transport delay [s], at most the longest that the queue can hold.
            dt: Control tick [s].
        """
        ticks = self._age(delay, dt)
        n = lax.stop_gradient(jnp.floor(ticks))
        after, before = (self.combine(self._hat(age)) for age in (n, n + 1.0))
        return before, after, (ticks - n) * dt

    def substeps(self, delay: Float[Array, ""], dt: float, n: int) -> Command:
        """Return the mean arriving command for each of ``n`` equal parts (leading axis) of the tick that begins now.

        Args:
            delay: Transport delay [s], at most the longest that the queue can hold.
            dt: Control tick [s].
            n: Number of parts.
        """
        rows = self.commands.c.shape[0]
        late = whole_steps(n * self._age(delay, dt), 1.0)
        begin = jnp.arange(n, dtype=late.dtype)[:, None]
        issue = n * jnp.arange(1.0 - rows, 1.0, dtype=late.dtype)[None] + late
        # Share of each part in which a command acts: from its arrival until the arrival of the next command.
        shares = jnp.clip(begin + 1.0 - issue, 0.0, 1.0) - jnp.clip(begin + 1.0 - n - issue, 0.0, 1.0)
        return jax.vmap(self.combine)(shares)

    def weights(self, delay: Float[Array, ""], dt: float) -> Float[Array, " n"]:
        """Return the share of each row in the mean command of the tick that begins now; the shares add up to one."""
        return self._hat(self._age(delay, dt))

    def combine(self, weights: Float[Array, " n"]) -> Command:
        """Return a weighted sum of the rows."""
        # A matrix product is avoided, since accelerators round its factors to fewer digits.
        c = jnp.sum(weights * self.commands.c)
        return Command(c, jnp.sum(weights[:, None] * self.commands.omega, axis=0))

    def _age(self, delay: Float[Array, ""], dt: float) -> Float[Array, ""]:
        """Return the age in ticks of the command that arrives when the tick begins."""
        # A delay beyond the end of the queue selects the oldest command, since a traced delay cannot be rejected.
        return jnp.minimum(whole_steps(delay.astype(self.commands.c.dtype), dt), self.commands.c.shape[0] - 1.0)

    def _hat(self, age: Float[Array, ""]) -> Float[Array, " n"]:
        n = self.commands.c.shape[0]
        ages = jnp.arange(n - 1, -1, -1, dtype=age.dtype)
        return jnp.clip(1.0 - jnp.abs(ages - age), 0.0, 1.0)


class PathState(eqx.Module):
    """Commands in transit, and the state of the actuators."""

    queue: CommandQueue
    actuators: ActuatorState


class CommandPath(eqx.Module):
    """The command path of a vehicle: the transport delay, and the response of thrust and body rates."""

    delay: Float[Array, ""]
    """Transport delay [s]."""
    response: ActuatorResponse

    @classmethod
    def of(cls, delay: float | Float[Array, ""] = 0.0, response: ActuatorResponse | None = None) -> "CommandPath":
        """Return a path.

        Args:
            delay: Transport delay [s].
            response: Response of thrust and body rates; None if they follow immediately.
        """
        return cls(strong_array(delay), ActuatorResponse.of() if response is None else response)

    @property
    def response_time(self) -> Float[Array, ""]:
        """Sum of the delay and the lag of the roll rate [s]."""
        return self.delay + self.response.rate_lag[0]

    def init(self, u: Command, dt: float, *, longest: float = LONGEST_DELAY) -> PathState:
        """Return the state of a vehicle that has always been commanded ``u``; see :meth:`CommandQueue.of`."""
        return PathState(CommandQueue.of(u, dt, longest=longest), ActuatorState.at(u))

    def __call__(self, s: PathState, u: Command, dt: float) -> tuple[Command, PathState]:
        """Advance by one control tick; the result is exact for commands that are held over each tick.

        Args:
            s: State at the beginning of the tick.
            u: Command that is issued for the tick.
            dt: Length of the tick [s].

        Returns:
            Mean thrust and body rates over the tick, and the state at its end.
        """
        queue = s.queue.push(u)
        mean, end = self.advance(queue, s.actuators, dt)
        return mean, PathState(queue, end)

    def advance(self, queue: CommandQueue, actuators: ActuatorState, dt: float) -> tuple[Command, ActuatorState]:
        """Advance the actuators by the tick for which the newest command in the queue was issued.

        Args:
            queue: Queue of issued commands.
            actuators: State at the beginning of the tick.
            dt: Length of the tick [s].

        Returns:
            Mean thrust and body rates over the tick, and the state at its end.
        """
        before, after, change = queue.pieces(self.delay, dt)
        first, middle = self.response(actuators, before, change)
        second, end = self.response(middle, after, dt - change)
        target = self.response.target(queue.arrival(self.delay, dt))
        mean = jax.tree.map(lambda each, a, b: each + (a + b) / dt, target, first, second)
        return mean, end

    def thrust(self, queue: CommandQueue, c: Float[Array, ""], dt: float) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """Advance only the thrust, by the tick for which the newest command in the queue was issued.

        Args:
            queue: Queue of issued commands.
            c: Thrust at the beginning of the tick [m/s^2].
            dt: Length of the tick [s].

        Returns:
            Mean thrust over the tick, and the thrust at its end [m/s^2].
        """
        before, after, change = queue.pieces(self.delay, dt)
        first, middle = self.response.thrust(c, self.response.target(before).c, change)
        second, end = self.response.thrust(middle, self.response.target(after).c, dt - change)
        return self.response.target(queue.arrival(self.delay, dt)).c + (first + second) / dt, end


def check_delay(delay: Float[Array, "*batch"], longest: float, name: str) -> None:
    """Reject a delay that a queue cannot hold; a traced delay or an array of delays is not checked.

    Args:
        delay: Transport delay [s].
        longest: Longest delay that the queue can hold [s].
        name: Name of the object with the delay, for the error message.

    Raises:
        ValueError: The delay is negative or too long.
    """
    if isinstance(delay, jax.core.Tracer) or not isinstance(delay, jax.Array) or delay.ndim:
        return
    if not 0.0 <= delay.item() <= longest * (1.0 + ROUNDING):
        raise ValueError(f"{name}.delay = {delay.item():g} s must be 0 to {longest:g} s; set longest_delay for more")


def queue_length(dt: float, longest: float = LONGEST_DELAY) -> int:
    """Return the length of a queue for delays up to ``longest`` [s] at a tick of ``dt`` [s]."""
    return math.ceil(longest / dt - ROUNDING) + 1


def whole_steps(time: Float[Array, "*shape"], dt: float) -> Float[Array, "*shape"]:
    """Return a time in steps of ``dt``; a number that is whole up to rounding errors is rounded."""
    steps = time / dt
    nearest = jnp.round(steps)
    rounding = jnp.where(jnp.abs(steps - nearest) < ROUNDING, nearest - steps, 0.0)
    return steps + lax.stop_gradient(rounding)
