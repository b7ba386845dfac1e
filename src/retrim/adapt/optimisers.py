"""The optimiser of an update: what it remembers of the last one, and how its rate falls."""

import abc

import equinox as eqx
import optax
from jaxtyping import Array, Float

from ..learn.bptt import PolicyState


class AbstractPolicyOptimiser(eqx.Module):
    """Adam behind a clip. Every number is an array, so that another value compiles nothing."""

    rate: eqx.AbstractVar[Float[Array, ""]]
    max_grad_norm: eqx.AbstractVar[Float[Array, ""]]

    @abc.abstractmethod
    def transformation(self, num_updates: int) -> optax.GradientTransformation:
        """Return the optimiser of an update of ``num_updates`` steps."""

    @abc.abstractmethod
    def begin(self, state: PolicyState, num_updates: int) -> PolicyState:
        """Return the state from which an update starts."""


class FreshAdam(AbstractPolicyOptimiser):
    """Each update starts a fresh Adam, whose rate falls to zero along a cosine (the paper)."""

    rate: Float[Array, ""]
    """Learning rate at the start of an update."""
    max_grad_norm: Float[Array, ""]
    """Largest norm of a policy gradient; infinity for none."""

    def transformation(self, num_updates: int) -> optax.GradientTransformation:
        """Return Adam with a rate that falls."""
        schedule = optax.cosine_decay_schedule(1.0, num_updates)
        return optax.chain(
            optax.clip_by_global_norm(self.max_grad_norm),
            optax.scale_by_adam(),
            optax.scale_by_schedule(lambda step: -self.rate * schedule(step)),
        )

    def begin(self, state: PolicyState, num_updates: int) -> PolicyState:
        """Forget the moments of the last update."""
        return PolicyState(state.policy, self.transformation(num_updates).init(state.policy.params))


class CarriedAdam(AbstractPolicyOptimiser):
    """One Adam of constant rate for the whole flight, so that the steps of short updates have the right size.

    The scale of the gradients is carried over, their direction is not: an update that was refused, or learnt across a
    change of the world, would push every later one the same way.
    """

    rate: Float[Array, ""]
    """Learning rate."""
    max_grad_norm: Float[Array, ""]
    """Largest norm of a policy gradient; infinity for none."""

    def transformation(self, num_updates: int) -> optax.GradientTransformation:
        """Return Adam; the number of steps does not matter."""
        clip = optax.clip_by_global_norm(self.max_grad_norm)
        return optax.chain(clip, optax.scale_by_adam(), optax.scale_by_learning_rate(self.rate))

    def begin(self, state: PolicyState, num_updates: int) -> PolicyState:
        """Keep the second moments; the first start at zero."""
        still = optax.tree.zeros_like(optax.tree.get(state.optimiser, "mu"))
        return PolicyState(state.policy, optax.tree.set(state.optimiser, mu=still))
