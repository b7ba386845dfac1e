"""Re-trains a policy in a model that was corrected with a log."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import random
from jaxtyping import Array, Key

from ..adapt.gate import all_finite
from ..adapt.learner_state import LearnerState
from ..config.methods import find_method
from ..config.setup import Setup
from ..control.policy import AbstractPolicy
from ..errors import LogError
from ..learn.residuals.model import FittedResidual
from ..learn.residuals.targets import Targets
from ..learn.window import Window
from ..physics.state import Command
from ..runkit.reporter import Reporter
from ..runkit.training import model_error
from .predictors import refit

PATIENCE = 5  # consecutive refused updates after which no further improvement is expected
LEAST_VALID = 0.5  # share of a window that must be valid


class AdaptationResult(NamedTuple):
    """Result of adapting to a log."""

    state: LearnerState
    admissions: int
    """Number of updates that the gate has admitted."""
    attempts: int
    before: float
    """The policy's error before the adaptation, in the corrected model [m]."""
    after: float
    """The policy's error after the adaptation, in the corrected model [m]."""


def adapt_to(
    rows: Targets, setup: Setup, policy: AbstractPolicy, *, method: str, updates: int, seed: int, reporter: Reporter
) -> AdaptationResult:
    """Fit the residual to a log, window by window as in flight, and re-train the policy in the corrected model.

    The updates start from the task's states, because the positions in a log are not those of the task. The gate admits
    or rejects each update.

    Args:
        rows: Rows of the log, with the preset's tick.
        setup: The policy's set-up.
        policy: Policy to re-train.
        method: A learning method: ``full``, ``lora``, or another registered one.
        updates: Maximum number of updates.
        seed: Seed for the learners.
        reporter: Receives the progress.

    Raises:
        LogError: No window of the log contains enough flight data.
    """
    k_init, k_delta, k_starts, k_learn = random.split(random.key(seed), 4)
    learner, prepare = setup.learner, find_method(method).learns
    state = learner.init(policy if prepare is None else prepare(setup, policy, k_delta), k_init)
    residual, policy_state, window = _fit(rows, setup, state.residual), state.policy, _starts(setup, k_starts)
    admissions = refusals = attempts = 0
    with reporter.progress("re-training") as advance:
        advance(0.0, "compiling")
        for key in random.split(k_learn, updates):
            candidate, verdict = learner.update_policy(policy_state, residual, window, key)
            attempts, refusals = attempts + 1, refusals + 1
            if bool(verdict.admitted):
                policy_state, admissions, refusals = candidate, admissions + 1, 0
            advance(attempts / updates, verdict.reason())
            if refusals == PATIENCE:
                break
        advance(1.0, f"{admissions} of {attempts} updates were better")
    residual_model = FittedResidual(learner.residual_model, residual)
    before, after = (model_error(setup, each.policy.merged(), residual_model) for each in (state.policy, policy_state))
    return AdaptationResult(LearnerState(policy_state, residual), admissions, attempts, before, after)


def ends_of_windows(rows: Targets, setup: Setup) -> list[int]:
    """Return the end of each of the learner's windows that contains enough flight data.

    Raises:
        LogError: There is no such window.
    """
    a, dt, valid = setup.preset.adapt, setup.preset.dt, np.asarray(rows.valid)
    ends = range(a.window, len(valid) + 1, max(1, round(a.fit_every / dt)))
    if not (result := [end for end in ends if valid[end - a.window : end].mean() >= LEAST_VALID]):
        raise LogError(f"the log has no {a.window * dt:g} s of flight in one piece, which the learner's window needs")
    return result


def _fit(rows: Targets, setup: Setup, state: Any) -> Any:
    """Return the state of the residual model after the last complete window."""
    has_fit = False
    for last in ends_of_windows(rows, setup):
        part: Targets = jax.tree.map(lambda leaf, last=last: leaf[last - setup.preset.adapt.window : last], rows)
        new = refit(setup.learner.residual_model, state, part)
        if bool(all_finite(new)):
            state, has_fit = new, True
    if not has_fit:
        raise LogError("no window of the log determines a finite residual; choose another --residual")
    return state


def _starts(setup: Setup, key: Key[Array, ""]) -> Window:
    """Return start states of the task, which replace the states in the flight."""
    n = setup.preset.adapt.window
    starts = jax.vmap(setup.learner.env.task.reset)(random.split(key, n))
    hover = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (n, *leaf.shape)), Command.hover(starts.x.p.dtype))
    return Window(starts.t, starts.x, hover, jnp.ones(n, dtype=bool))
