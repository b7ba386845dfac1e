"""What learning from rewards is given: an environment that needs no gradient."""

from typing import Generic, NamedTuple, Protocol, TypeVar, runtime_checkable

from jaxtyping import Array, Bool, Float, Key

S = TypeVar("S")


class Outcome(NamedTuple):
    """What a step of an environment led to."""

    reward: Float[Array, ""]
    terminated: Bool[Array, ""]
    """The episode is over, and nothing more can be won."""
    truncated: Bool[Array, ""]
    """The episode is cut off by its time limit."""


@runtime_checkable
class Problem(Protocol, Generic[S]):
    """An environment to learn in; all are pure functions of one state."""

    def reset(self, key: Key[Array, ""]) -> S:
        """Return the state at the start of an episode; the key is consumed."""
        ...

    def observe(self, s: S, key: Key[Array, ""]) -> Float[Array, " o"]:
        """Return the observation; the key is for its noise."""
        ...

    def step(self, s: S, action: Float[Array, " a"], key: Key[Array, ""]) -> tuple[S, Outcome]:
        """Return the next state, and what the action led to."""
        ...
