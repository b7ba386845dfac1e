"""Observations of a tracking policy that contain the tracking error: state-based tracking as in the paper.

The paper gives o = [p, R, v] for both hover and tracking. Taken literally for tracking, this observation (``blind``)
does not contain the phase of the reference. The two classes here implement the other readings.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..physics.effective_gravity import EffectiveGravityFrame
from ..physics.state import Command, State
from .abstract_reference import AbstractReference
from .observation import POSITION_SCALE, VELOCITY_SCALE, AbstractObservation, StateObs


class RelativeObs(AbstractObservation[Float[Array, "history 4"]]):
    """o = [p - p_ref(t), R, v - v_ref(t)] and the last ``history`` commands: 15 + 4 ``history`` numbers.

    The policy observes its error, but not its position on the reference, so it cannot anticipate the path.
    """

    reference: AbstractReference
    omega_max: Float[Array, "3"]
    history: int = eqx.field(static=True, default=0)

    @property
    def size(self) -> int:
        """Length of the observation: 15 + 4 ``history``."""
        return self._own.size

    def init(self, x: State) -> Float[Array, "history 4"]:
        """Return the memory of a vehicle that has hovered until now."""
        return self._own.init(x)

    def __call__(
        self, memory: Float[Array, "history 4"], t: Float[Array, ""], x: State, last: Command
    ) -> tuple[Float[Array, " o"], Float[Array, "history 4"]]:
        """Return the scaled state relative to the reference, in world axes, and the commands."""
        here = self.reference(t)
        return self._own(memory, t, State(x.p - here.p, x.R, x.v - here.v), last)

    @property
    def _own(self) -> StateObs:
        """Observation of the state in axes that move with the reference."""
        return StateObs(jnp.zeros_like(self.omega_max), self.omega_max, self.history)

    def in_frame(self, frame: EffectiveGravityFrame) -> "RelativeObs":
        """Return the observation relative to the reference in ``frame``."""
        return RelativeObs(self.reference.in_frame(frame), self.omega_max, self.history)


class StateAndErrorObs(AbstractObservation[Float[Array, "history 4"]]):
    """o = [p, R, v, the last ``history`` commands, p - p_ref(t), v - v_ref(t)]: 21 + 4 ``history`` numbers.

    Position, velocity and error together determine the position on the reference. The policy can memorise one reference
    and anticipate its corners; the velocity resolves the ambiguity of a reference that crosses itself.
    """

    reference: AbstractReference
    state: StateObs

    @property
    def size(self) -> int:
        """Length of the observation: 21 + 4 ``history``."""
        return self.state.size + 6

    def init(self, x: State) -> Float[Array, "history 4"]:
        """Return the memory of a vehicle that has hovered until now."""
        return self.state.init(x)

    def __call__(
        self, memory: Float[Array, "history 4"], t: Float[Array, ""], x: State, last: Command
    ) -> tuple[Float[Array, " o"], Float[Array, "history 4"]]:
        """Return the scaled state, the commands and the scaled error, in world axes."""
        here = self.reference(t)
        state_part, memory = self.state(memory, t, x, last)
        return jnp.concatenate([state_part, (x.p - here.p) / POSITION_SCALE, (x.v - here.v) / VELOCITY_SCALE]), memory

    def in_frame(self, frame: EffectiveGravityFrame) -> "StateAndErrorObs":
        """Return the observation of the reference in ``frame``."""
        return StateAndErrorObs(self.reference.in_frame(frame), self.state.in_frame(frame))
