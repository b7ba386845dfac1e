"""The two workers of an online learner: one fits the residual, and one re-trains the policy."""

from typing import Any

import jax
import numpy as np
from jax import random
from jaxtyping import Array, Key

from ..control.lora import LoraPolicy
from ..control.policy import AbstractPolicy
from ..learn.bptt import PolicyState
from ..learn.devices import suitable_device
from ..learn.screening import describe_counts
from ..learn.window import Window
from .gate import Verdict
from .learner import OnlineLearner
from .learner_state import FitReport, LearnerState
from .updates import Layer, PolicyUpdate, Rejection, ResidualUpdate, Update
from .worker import Worker


def residual_update(computed_from: float, state: Any, report: FitReport) -> ResidualUpdate | Rejection:
    """Return the message for a finished fit."""
    excluded = describe_counts(report.contradictions)
    if not report.accepted:
        reason = "the residual's fit is not finite, or no tick of the window can be used"
        return Rejection(
            computed_from, "residual", f"{reason} (measurements excluded: {excluded})" if excluded else reason
        )
    counts = tuple(np.asarray(report.contradictions).tolist())
    return ResidualUpdate(computed_from, float(report.rms_error), state, counts)


def policy_update(computed_from: float, state: PolicyState, verdict: Verdict) -> PolicyUpdate | Rejection:
    """Return the message for a finished policy update."""
    if not verdict.admitted:
        return Rejection(computed_from, "policy", verdict.reason())
    return PolicyUpdate(computed_from, float(verdict.candidate), float(verdict.incumbent), state)


class ResidualWorker(Worker):
    """Fits the residual model, starting from its last published fit."""

    layer: Layer = "residual"

    def __init__(self, learner: OnlineLearner, state: LearnerState) -> None:
        self.learner, self._residual = learner, state.residual

    @property
    def state(self) -> Any:
        """State of the residual model from which the next fit starts."""
        return self._residual

    def learn(self, window: Window) -> ResidualUpdate | Rejection:
        """Fit the residual to ``window``."""
        with suitable_device(self._residual, 1):
            fitted, report = jax.block_until_ready(self.learner.fit_residual(self._residual, window))
        return residual_update(float(window.t[-1]), fitted, report)

    def receive(self, update: Update) -> None:
        """Continue from a published fit."""
        if isinstance(update, ResidualUpdate):
            self._residual = update.state


class PolicyWorker(Worker):
    """Re-trains the policy in the nominal model plus the last published residual."""

    layer: Layer = "policy"

    def __init__(self, learner: OnlineLearner, state: LearnerState, key: Key[Array, ""]) -> None:
        self.learner, self.key = learner, key
        self._policy: PolicyState = state.policy
        self._residual = state.residual

    @property
    def state(self) -> LearnerState:
        """Policy and residual from which the next update starts."""
        return LearnerState(self._policy, self._residual)

    @property
    def policy(self) -> AbstractPolicy | LoraPolicy:
        """Policy from which the next update starts."""
        return self._policy.policy

    def next_key(self) -> Key[Array, ""]:
        """Return the key of the next update; each call returns a new key."""
        self.key, key = random.split(self.key)
        now: Key[Array, ""] = key
        return now

    def learn(self, window: Window) -> PolicyUpdate | Rejection:
        """Re-train the policy; the window provides starts for the gate."""
        key = self.next_key()
        with suitable_device(self._policy.policy, self.learner.num_envs):
            updated = self.learner.update_policy(self._policy, self._residual, window, key)
            trained, verdict = jax.block_until_ready(updated)
        return policy_update(float(window.t[-1]), trained, verdict)

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
