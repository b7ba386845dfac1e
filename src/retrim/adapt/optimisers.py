"""Optimisers of policy updates, with the state kept between updates and the decay of the learning rate."""

import abc
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float

from ..learn.bptt import PolicyState


class AbstractPolicyOptimiser(eqx.Module):
    """Optimiser of policy updates. Every number is an array, so a new value does not trigger a recompilation."""

    rate: eqx.AbstractVar[Float[Array, ""]]
    max_grad_norm: eqx.AbstractVar[Float[Array, ""]]

    @abc.abstractmethod
    def transformation(self, num_updates: int) -> optax.GradientTransformation:
        """Return the optimiser for an update of ``num_updates`` steps."""

    @abc.abstractmethod
    def begin(self, state: PolicyState, num_updates: int) -> PolicyState:
        """Return the state from which an update starts."""


class FreshAdam(AbstractPolicyOptimiser):
    """A fresh Adam for each update, with a rate that decays to zero on a cosine schedule (as in the paper)."""

    rate: Float[Array, ""]
    """Learning rate at the start of an update."""
    max_grad_norm: Float[Array, ""]
    """Largest norm of a policy gradient; infinity for no limit."""

    def transformation(self, num_updates: int) -> optax.GradientTransformation:
        """Return Adam with a decaying rate."""
        schedule = optax.cosine_decay_schedule(1.0, num_updates)
        return optax.chain(
            optax.clip_by_global_norm(self.max_grad_norm),
            optax.scale_by_adam(),
            optax.scale_by_schedule(lambda step: -self.rate * schedule(step)),
        )

    def begin(self, state: PolicyState, num_updates: int) -> PolicyState:
        """Reset the moments of the previous update."""
        return PolicyState(state.policy, self.transformation(num_updates).init(state.policy.params))


class CarriedAdam(AbstractPolicyOptimiser):
    """One Adam with a constant rate for the whole flight; its momentum starts from rest in each update.

    The scale of the gradients is carried over, but their direction is not. Otherwise an update that was refused, or
    that was learned across a change of the world, would push every later one in the same direction. The first moment is
    not bias-corrected, so that every update, including the first, begins gently: along a constant gradient, five steps
    move by 1.3 times the rate.
    """

    rate: Float[Array, ""]
    """Learning rate."""
    max_grad_norm: Float[Array, ""]
    """Largest norm of a policy gradient; infinity for no limit."""

    def transformation(self, num_updates: int) -> optax.GradientTransformation:
        """Return Adam, which does not depend on the number of steps."""
        clip = optax.clip_by_global_norm(self.max_grad_norm)
        return optax.chain(clip, _scale_by_adam_from_rest(), optax.scale_by_learning_rate(self.rate))

    def begin(self, state: PolicyState, num_updates: int) -> PolicyState:
        """Keep the second moments, and reset the first moments to zero."""
        still = optax.tree.zeros_like(optax.tree.get(state.optimiser, "mu"))
        return PolicyState(state.policy, optax.tree.set(state.optimiser, mu=still))


def _scale_by_adam_from_rest(b1: float = 0.9, b2: float = 0.999, eps: float = 1e-8) -> optax.GradientTransformation:
    """Return ``optax.scale_by_adam`` without the bias correction of the first moment."""
    adam = optax.scale_by_adam(b1, b2, eps)

    def update(grads: optax.Updates, state: Any, params: optax.Params | None = None) -> tuple[optax.Updates, Any]:
        _, after = adam.update(grads, state, params)
        nu = optax.tree.bias_correction(after.nu, b2, after.count)
        return jax.tree.map(lambda m, v: m / (jnp.sqrt(v) + eps), after.mu, nu), after

    return optax.GradientTransformation(adam.init, update)
