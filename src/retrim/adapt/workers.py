"""The two workers of an online learner: one fits the residual, and one re-trains the policy."""

from typing import Any

import jax
from jax import random
from jaxtyping import Array, Key

from ..control.lora import LoraPolicy
from ..learn.bptt import PolicyState
from ..learn.devices import suitable_device
from ..learn.window import Window
from .batched_workers import PolicyBatch, ResidualBatch
from .learner import OnlineLearner
from .learner_state import LearnerState
from .updates import Layer, PolicyUpdate, Rejection, ResidualUpdate, Update, policy_update, residual_update
from .worker import Worker


class ResidualWorker(Worker):
    """Fits the residual model, starting from its last published fit."""

    layer: Layer = "residual"
    batch = ResidualBatch

    def __init__(self, learner: OnlineLearner, state: LearnerState) -> None:
        self.learner, self._residual = learner, state.residual

    @property
    def state(self) -> Any:
        """State of the residual model from which the next fit starts."""
        return self._residual

    def state_in(self, state: LearnerState) -> Any:
        """Return the residual's state."""
        return state.residual

    def learn(self, window: Window) -> ResidualUpdate | Rejection:
        """Fit the residual to ``window``."""
        with suitable_device(self._residual, 1):
            residual, report = jax.block_until_ready(self.learner.fit_residual(self._residual, window))
        return residual_update(float(window.t[-1]), residual, report)

    def receive(self, update: Update) -> None:
        """Continue from a published fit."""
        if isinstance(update, ResidualUpdate):
            self._residual = update.state


class PolicyWorker(Worker):
    """Re-trains the policy in the nominal model plus the last published residual."""

    layer: Layer = "policy"
    batch = PolicyBatch

    def __init__(self, learner: OnlineLearner, state: LearnerState, key: Key[Array, ""]) -> None:
        self.learner, self.key = learner, key
        self._policy: PolicyState = state.policy
        self._residual = state.residual

    @property
    def state(self) -> LearnerState:
        """Policy and residual from which the next update starts."""
        return LearnerState(self._policy, self._residual)

    @property
    def low_rank(self) -> LoraPolicy | None:
        """Policy from which the next update starts, if it is a low-rank policy."""
        return self._policy.policy if isinstance(self._policy.policy, LoraPolicy) else None

    def learn(self, window: Window) -> PolicyUpdate | Rejection:
        """Re-train the policy; the window provides starts for the gate."""
        self.key, key = random.split(self.key)
        with suitable_device(self._policy.policy, self.learner.num_envs):
            candidate = self.learner.update_policy(self._policy, self._residual, window, key)
            trained_policy, verdict = jax.block_until_ready(candidate)
        return policy_update(float(window.t[-1]), trained_policy, verdict)

    def receive(self, update: Update) -> None:
        """Continue from a published policy, or with a published residual in the model."""
        if isinstance(update, PolicyUpdate):
            self._policy = update.state
        elif isinstance(update, ResidualUpdate):
            self._residual = update.state


def make_worker(learner: OnlineLearner, layer: Layer, state: LearnerState, key: Key[Array, ""]) -> Worker:
    """Return the worker for a learning layer.

    Args:
        learner: Learner of the flight; it may provide its own worker.
        layer: ``residual`` or ``policy``.
        state: Learner state at the start of the flight.
        key: Random key, consumed.
    """
    custom = learner.worker(layer, state, key)
    if custom is not None:
        return custom
    return ResidualWorker(learner, state) if layer == "residual" else PolicyWorker(learner, state, key)
