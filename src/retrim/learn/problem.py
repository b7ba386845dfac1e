"""The environment for learning from rewards, without gradients."""

from typing import Generic, NamedTuple, Protocol, TypeVar, runtime_checkable

from jaxtyping import Array, Bool, Float, Key

S = TypeVar("S")


class Outcome(NamedTuple):
    """Result of one environment step."""

    reward: Float[Array, ""]
    terminated: Bool[Array, ""]
    """True if the episode is over and there are no further rewards."""
    truncated: Bool[Array, ""]
    """True if the time limit cuts the episode off."""


@runtime_checkable
class Problem(Protocol, Generic[S]):
    """An environment for learning; all methods are pure functions of one state."""

    def reset(self, key: Key[Array, ""]) -> S:
        """Return the state at the start of an episode; the key is consumed."""
        ...

    def observe(self, s: S, key: Key[Array, ""]) -> Float[Array, " o"]:
        """Return the observation; the key is used for the observation's noise."""
        ...

    def step(self, s: S, action: Float[Array, " a"], key: Key[Array, ""]) -> tuple[S, Outcome]:
        """Return the next state and the outcome of the action."""
        ...
