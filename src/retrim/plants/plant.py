"""The imperative interface to the world; simulators and vehicles implement the same three calls."""

import math
from types import TracebackType
from typing import NamedTuple, Protocol, TypeVar, runtime_checkable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..errors import PlantError
from ..physics.state import Command, State

P = TypeVar("P")


class Measurement(NamedTuple):
    """Measurement from a plant at the end of a tick."""

    t: float
    """Time on the plant's clock, whose origin is arbitrary [s]."""
    x: State
    """Measured position, attitude and velocity."""
    omega: Float[Array, "3"] | None = None
    """Body rates [rad/s], if they are measured."""
    a: Float[Array, "3"] | None = None
    """Mean acceleration over the tick in the world frame [m/s^2], if it is measured."""
    motor_speeds: Float[Array, "4"] | None = None
    """Rotor speeds [rad/s], if they are measured."""
    battery: float | None = None
    """Remaining charge, 0 to 1, if it is known."""
    age: float = 0.0
    """Time since the state was valid [s]."""
    truth: State | None = None
    """True state, if it is available in addition to the measured state; used for scores, never by pilots."""

    @property
    def p(self) -> Float[Array, "3"]:
        """Measured position in the world frame [m]."""
        return self.x.p

    @property
    def R(self) -> Float[Array, "3 3"]:
        """Measured attitude, body to world."""
        return self.x.R

    @property
    def v(self) -> Float[Array, "3"]:
        """Measured velocity in the world frame [m/s]."""
        return self.x.v

    @property
    def true_state(self) -> State:
        """True state, or the measured one if the true state is not available."""
        return self.x if self.truth is None else self.truth


@runtime_checkable
class Plant(Protocol):
    """Interface of a plant: three calls, and a context manager that stops the plant on exit.

    A plant derives from this class or implements the same methods.
    """

    dt: float
    """Length of a control tick [s]."""

    def reset(self, x0: State | None) -> Measurement:
        """Start a flight.

        Args:
            x0: Initial state; None for the current state of the vehicle.

        Returns:
            The first measurement.

        Raises:
            PlantError: The plant cannot start at ``x0``.
        """
        ...

    def step(self, u: Command) -> tuple[Measurement, Command]:
        """Apply a command for one tick and block until the tick is over.

        Args:
            u: The command.

        Returns:
            The measurement at the end of the tick, and the command that was accepted: ``u`` itself unless the plant
            limited it.

        Raises:
            PlantError: The command is not finite (it is then not sent to the vehicle), or the plant was stopped.
        """
        ...

    def stop(self) -> None:
        """Bring the vehicle to a safe state; idempotent, and always called at the end of a flight."""
        ...

    def __enter__(self: P) -> P:
        """Return the plant."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop the plant."""
        self.stop()


def as_numpy(u: Command) -> np.ndarray:
    """Return [c, omega] as a NumPy array, without a JAX operation."""
    return np.append(np.asarray(u.c), np.asarray(u.omega))


def check_command(u: Command, plant: str) -> np.ndarray:
    """Raise an error if a command is not finite; every plant calls this function first.

    Args:
        u: The command.
        plant: Name of the plant, for the error message.

    Returns:
        The command as returned by :func:`as_numpy`.

    Raises:
        PlantError: The command is not finite; the message contains the plant and the entry.
    """
    command = as_numpy(u)
    for name, value in zip(("c", "omega[0]", "omega[1]", "omega[2]"), command.tolist(), strict=True):
        if not math.isfinite(value):
            raise PlantError(f"{plant}: command refused, {name} = {value} is not finite")
    return command


def limit_command(u: Command, command: np.ndarray, low: np.ndarray, high: np.ndarray) -> Command:
    """Return ``u`` clipped to limits of [c, omega], or ``u`` itself if within them; ``command`` is ``u`` as array."""
    if (low <= command).all() and (command <= high).all():
        return u
    limited_u = np.clip(command, low, high).astype(command.dtype)
    return Command(jnp.asarray(limited_u[0]), jnp.asarray(limited_u[1:]))
