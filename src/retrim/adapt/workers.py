"""Workers: what one learner does with one window, whichever clock or process it runs in.

A worker's state advances only when its own update comes back to it as published, so that a result that is dropped on
the way (a new flight, a lost message) never becomes the base of the next one.
"""

from typing import Any, Protocol, runtime_checkable

import jax
import numpy as np
from jax import random
from jaxtyping import Array, Key

from ..control.lora import LoraPolicy
from ..control.policy import Policy
from ..learn.bptt import PolicyState
from ..learn.screening import describe_counts
from ..learn.window import Window
from .gate import Verdict
from .learner import FitReport, LearnerState, OnlineLearner
from .updates import Layer, PolicyUpdate, Rejection, ResidualUpdate, Update


@runtime_checkable
class Worker(Protocol):
    """One layer of learning."""

    layer: Layer

    def learn(self, window: Window) -> Update:
        """Learn from a window; blocks until the result is there."""
        ...

    def receive(self, update: Update) -> None:
        """Take note of an update that was published, of this or another layer."""
        ...


def residual_update(computed_from: float, state: Any, report: FitReport) -> ResidualUpdate | Rejection:
    """Return the message of a fit that has ended."""
    excluded = describe_counts(report.contradictions)
    if not report.accepted:
        reason = "the residual's fit is not finite, or no tick of the window can be used"
        return Rejection(
            computed_from, "residual", f"{reason} (measurements excluded: {excluded})" if excluded else reason
        )
    counts = tuple(np.asarray(report.contradictions).tolist())
    return ResidualUpdate(computed_from, float(report.rms_error), state, counts)


def policy_update(computed_from: float, state: PolicyState, verdict: Verdict) -> PolicyUpdate | Rejection:
    """Return the message of an update of the policy that has ended."""
    if not verdict.admitted:
        return Rejection(computed_from, "policy", verdict.reason())
    return PolicyUpdate(computed_from, float(verdict.candidate), float(verdict.incumbent), state)


class ResidualWorker:
    """Fits the residual model, from where its last published fit ended."""

    layer: Layer = "residual"

    def __init__(self, learner: OnlineLearner, state: LearnerState) -> None:
        self.learner, self._residual = learner, state.residual

    @property
    def state(self) -> Any:
        """What a fit goes on from."""
        return self._residual

    def learn(self, window: Window) -> ResidualUpdate | Rejection:
        """Fit to ``window``."""
        fitted, report = jax.block_until_ready(self.learner.fit_residual(self._residual, window))
        return residual_update(float(window.t[-1]), fitted, report)

    def receive(self, update: Update) -> None:
        """Go on from a published fit."""
        if isinstance(update, ResidualUpdate):
            self._residual = update.state


class PolicyWorker:
    """Re-trains the policy in the nominal model plus the last published residual."""

    layer: Layer = "policy"

    def __init__(self, learner: OnlineLearner, state: LearnerState, key: Key[Array, ""]) -> None:
        self.learner, self.key = learner, key
        self._policy: PolicyState = state.policy
        self._residual = state.residual

    @property
    def state(self) -> LearnerState:
        """What an update goes on from: a policy, in the model of a residual."""
        return LearnerState(self._policy, self._residual)

    @property
    def policy(self) -> Policy | LoraPolicy:
        """The policy that an update goes on from."""
        return self._policy.policy

    def next_key(self) -> Key[Array, ""]:
        """Return the key of an update; each call returns another."""
        self.key, key = random.split(self.key)
        now: Key[Array, ""] = key
        return now

    def learn(self, window: Window) -> PolicyUpdate | Rejection:
        """Re-train; the window gives starts for the gate."""
        key = self.next_key()
        trained, verdict = jax.block_until_ready(self.learner.update_policy(self._policy, self._residual, window, key))
        return policy_update(float(window.t[-1]), trained, verdict)

    def receive(self, update: Update) -> None:
        """Go on from a published policy, in the model of a published residual."""
        if isinstance(update, PolicyUpdate):
            self._policy = update.state
        elif isinstance(update, ResidualUpdate):
            self._residual = update.state
