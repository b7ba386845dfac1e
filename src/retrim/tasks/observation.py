"""Observations o = h(x); roll-outs, evaluation and flight use the same function."""

import abc
from collections.abc import Callable
from typing import Generic, TypeVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key

from ..errors import FrameError
from ..physics.actuator_response import ActuatorState
from ..physics.dynamics import Residual
from ..physics.effective_gravity import EffectiveGravityFrame
from ..physics.path_family import PathBelief
from ..physics.state import STANDARD_GRAVITY, Command, State
from .motions import Motions
from .state_estimate import StateEstimate

M = TypeVar("M")

POSITION_SCALE = 1.5  # [m], half the side of the world box in the published training set-up
VELOCITY_SCALE = 5.0  # [m/s], the same


class AbstractObservation(eqx.Module, Generic[M]):
    """Observation h(x) with a memory of type ``M`` between ticks; the memory has a fixed shape."""

    @property
    @abc.abstractmethod
    def size(self) -> int:
        """Length of the observation."""

    @abc.abstractmethod
    def init(self, x: State) -> M:
        """Return the memory at the start of a flight or roll-out."""

    @abc.abstractmethod
    def __call__(self, memory: M, t: Float[Array, ""], x: State, last: Command) -> tuple[Float[Array, " o"], M]:
        """Return one observation; called at every tick.

        Args:
            memory: Memory from :meth:`init` or from the previous call.
            t: Task time [s].
            x: State.
            last: Command issued one tick ago.

        Returns:
            The observation, and the new memory with the same shapes.
        """

    def at_rest(self, x: State) -> Float[Array, " o"]:
        """Return the observation of a vehicle at rest in ``x``; noisy observations override this to omit the noise."""
        o, _ = self(self.init(x), jnp.zeros_like(x.p[0]), x, Command.hover(x.p.dtype))
        return o

    def with_belief(self, belief: PathBelief) -> "AbstractObservation[M]":
        """Return the same observation with a belief about the vehicle; by default, the belief is not observed.

        Args:
            belief: Belief about the command path.
        """
        del belief
        return self

    def with_actuators(self, actuators: ActuatorState) -> "AbstractObservation[M]":
        """Return the same observation with the current thrust and rates; by default, they are not observed.

        Args:
            actuators: Current thrust and body rates.
        """
        del actuators
        return self

    def in_frame(self, frame: EffectiveGravityFrame) -> "AbstractObservation[M]":
        """Return the same observation for states and commands in ``frame``.

        Raises:
            FrameError: The observation does not support other frames.
        """
        raise FrameError(f"{type(self).__name__} cannot be transformed into a different frame")

    @property
    def previews_residual(self) -> bool:
        """Whether a learned residual belongs to the observation; by default, the frame of flight contains it."""
        return False

    def with_residual(self, residual: Residual) -> "AbstractObservation[M]":
        """Return the same observation with an expected disturbance; by default, it is not observed.

        Args:
            residual: Acceleration beyond the nominal model, world frame [m/s^2].
        """
        del residual
        return self

    @property
    def measures_state(self) -> bool:
        """Whether the vehicle measures its state, so that controllers may use it; False for images, for example."""
        return True

    @property
    def state_estimator(self) -> Callable[[M], StateEstimate] | None:
        """Function that reads an estimate of state and disturbance from the memory; by default, None.

        Controllers that need the full state use this estimate in flight, and so does the frame of effective gravity.
        """
        return None

    @property
    def has_frame_in_memory(self) -> bool:
        """Whether the memory depends on the frame, so the frame must be constant in training; by default, False."""
        return False

    def state_examples(
        self, motions: Motions
    ) -> Callable[[Key[Array, ""]], tuple[Float[Array, " o"], Float[Array, "15"]]] | None:
        """Return a function from a random key to an observation and the scaled state [p, R, v]; by default, None.

        The hidden layers of a policy can be pretrained with such examples, see :mod:`retrim.learn.encoder`.

        Args:
            motions: Distribution of the motions in the examples.
        """
        del motions
        return None

    def image(self, x: State) -> tuple[Float[Array, "points 2"], Bool[Array, " points"]] | None:
        """Return the points in the camera image and whether each is visible; by default, None, for no camera.

        Args:
            x: State of the vehicle.

        Returns:
            Image coordinates, in which the image is [-1, 1] x [-1, 1], and the visibility of each point.
        """
        del x
        return None


def with_command(
    memory: Float[Array, "history 4"], last: Command, omega_max: Float[Array, "3"]
) -> Float[Array, "history 4"]:
    """Return the scaled last commands, oldest first, after one more command.

    Args:
        memory: Scaled commands until now.
        last: Command in the past tick: thrust [m/s^2] and body rates [rad/s].
        omega_max: Largest body rates of the vehicle [rad/s].
    """
    scaled_command = jnp.concatenate([(last.c / STANDARD_GRAVITY - 1.0)[None], last.omega / omega_max])
    return jnp.concatenate([memory, scaled_command[None]])[1:]


class StateObs(AbstractObservation[Float[Array, "history 4"]]):
    """o = [p, R, v] and the last ``history`` commands, oldest first: 15 + 4 ``history`` numbers.

    The paper uses ``history=0`` (15 numbers). The authors' code uses ``history=3`` (27 numbers), which restores the
    Markov property for a command delay of up to three ticks. The position is relative to ``origin``, and every entry
    is scaled to order one.
    """

    origin: Float[Array, "3"]
    omega_max: Float[Array, "3"]
    history: int = eqx.field(static=True, default=0)

    @property
    def size(self) -> int:
        """Length of the observation: 15 + 4 ``history``."""
        return 15 + 4 * self.history

    def init(self, x: State) -> Float[Array, "history 4"]:
        """Return the memory of a vehicle that has hovered until now."""
        return jnp.zeros((self.history, 4), dtype=x.p.dtype)

    def __call__(
        self, memory: Float[Array, "history 4"], t: Float[Array, ""], x: State, last: Command
    ) -> tuple[Float[Array, " o"], Float[Array, "history 4"]]:
        """Return the scaled state and commands."""
        memory = with_command(memory, last, self.omega_max)
        state = jnp.concatenate([(x.p - self.origin) / POSITION_SCALE, x.R.reshape(9), x.v / VELOCITY_SCALE])
        return jnp.concatenate([state, memory.reshape(-1)]), memory

    def in_frame(self, frame: EffectiveGravityFrame) -> "StateObs":
        """Return the observation relative to the same origin, in ``frame``."""
        return StateObs(frame.vector(self.origin), self.omega_max, self.history)
