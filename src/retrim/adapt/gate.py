"""The gate, which admits a re-trained policy only if it is finite and not worse than the current one."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from ..control.policy import AbstractPolicy
from ..learn.bptt import policy_loss
from ..learn.env import Env
from ..tasks.task import Start


class Verdict(eqx.Module):
    """The gate's decision and its grounds."""

    admitted: Bool[Array, ""]
    finite: Bool[Array, ""]
    """True if all weights of the candidate are finite."""
    candidate: Float[Array, ""]
    """Cost of the candidate: the negative mean reward of its roll-outs."""
    incumbent: Float[Array, ""]
    """Cost of the policy in flight."""
    trusted: Bool[Array, ""] = eqx.field(default_factory=lambda: jnp.array(True))
    """True if enough measurements in the window are consistent with each other."""

    def require(self, trusted: Bool[Array, ""]) -> "Verdict":
        """Return a verdict that admits the candidate only if the measurements are also trusted."""
        return Verdict(self.admitted & trusted, self.finite, self.candidate, self.incumbent, trusted)

    def reason(self) -> str:
        """Return the grounds in words, for the log."""
        if not self.trusted:
            return "most measurements of the window contradict each other"
        if not self.finite:
            return "a weight is not finite"
        costs = f"{float(self.candidate):.4f} against {float(self.incumbent):.4f}"
        return f"cost {costs}" if self.admitted else f"worse than the incumbent: cost {costs}"


def all_finite(tree: Any) -> Bool[Array, ""]:
    """Return whether every number in ``tree`` is finite."""
    return jnp.all(jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(tree)]))


def judge(candidate: AbstractPolicy, incumbent: AbstractPolicy, env: Env, x0: Start) -> Verdict:
    """Compare two policies on the same roll-outs.

    Args:
        candidate: The re-trained policy.
        incumbent: The policy in flight.
        env: Task and current hybrid model.
        x0: Starts (leading axis) on which the candidate was not trained.

    Returns:
        The verdict; the candidate is admitted if it is finite and its cost is not higher.
    """
    both = jax.tree.map(lambda a, b: jnp.stack([a, b]), candidate, incumbent)
    new, old = lax.map(lambda policy: policy_loss(policy, env, x0), both)  # one after the other, as one program
    sound = all_finite(candidate.params)
    better = (new <= old) | ~jnp.isfinite(old)
    return Verdict(sound & jnp.isfinite(new) & better, sound, new, old)
