"""Whatever flies: a function from time and state to a command, with a memory of fixed shape."""

import abc
from typing import Any, Generic, TypeVar

import equinox as eqx
from jaxtyping import Array, Float

from ..physics.state import Command, State
from ..tasks.observation import AbstractObservation
from .policy import Policy

M = TypeVar("M")


class AbstractController(eqx.Module, Generic[M]):
    """Learned policies, model-predictive control and classical laws alike."""

    @abc.abstractmethod
    def init(self, x: State) -> M:
        """Memory at take-off in the state ``x``."""

    @abc.abstractmethod
    def __call__(self, memory: M, t: Float[Array, ""], x: State) -> tuple[Command, M]:
        """The command at time ``t`` [s], and the new memory."""


class PolicyController(AbstractController[tuple[Any, Command]]):
    """Observation, then policy. It remembers what the observation remembers, and its last command."""

    observation: AbstractObservation[Any]
    policy: Policy

    def init(self, x: State) -> tuple[Any, Command]:
        """As if the vehicle had hovered until now."""
        return self.observation.init(x), self.policy.u_hover

    def __call__(
        self, memory: tuple[Any, Command], t: Float[Array, ""], x: State
    ) -> tuple[Command, tuple[Any, Command]]:
        """One observation, one forward pass."""
        seen, last = memory
        o, seen = self.observation(seen, t, x, last)
        u = self.policy(o)
        return u, (seen, u)
