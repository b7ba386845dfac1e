"""Admission: what was learnt must be finite, and no worse than what flies, before anyone sees it."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..control.policy import Policy
from ..learn.bptt import policy_loss
from ..physics.dynamics import AbstractDynamics
from ..tasks.task import AbstractTask, Start


class Verdict(eqx.Module):
    """What the gate found."""

    admitted: Bool[Array, ""]
    finite: Bool[Array, ""]
    """No weight of the candidate is NaN or infinite."""
    candidate: Float[Array, ""]
    """Its cost: minus the mean reward of the roll-outs; a crash is charged to the end."""
    incumbent: Float[Array, ""]

    def reason(self) -> str:
        """In words, for the log."""
        if not self.finite:
            return "a weight is not finite"
        costs = f"{float(self.candidate):.4f} against {float(self.incumbent):.4f}"
        return f"cost {costs}" if self.admitted else f"worse than the incumbent: cost {costs}"


def finite(tree: Any) -> Bool[Array, ""]:
    """Whether every number in ``tree`` is finite."""
    return jnp.all(jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(tree)]))


def judge(
    candidate: Policy,
    incumbent: Policy,
    dynamics: AbstractDynamics[Any],
    task: AbstractTask,
    x0: Start,
    *,
    delay: int = 0,
) -> Verdict:
    """Fly both from the same starts ``x0`` (leading axis) through ``dynamics``, the current hybrid model."""
    new = policy_loss(candidate, dynamics, task, x0, delay=delay)
    old = policy_loss(incumbent, dynamics, task, x0, delay=delay)
    sound = finite(candidate.layers)
    better = (new <= old) | ~jnp.isfinite(old)
    return Verdict(sound & jnp.isfinite(new) & better, sound, new, old)
