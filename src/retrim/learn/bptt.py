"""Policy optimisation by back-propagation through time (paper, Sec. III-C, Eq. (2) and (3))."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jax import lax
from jaxtyping import Array, Float

from ..control.lora import LoraPolicy
from ..control.policy import Inputs, Policy, Taps
from ..physics.dynamics import AbstractDynamics
from ..tasks.task import AbstractTask, Start
from . import taps
from .rollout import Trajectory, rollout, tapped_rollout


class PolicyState(eqx.Module):
    """A policy, plain or low-rank, and the state of its optimiser, which knows ``policy.trained`` only."""

    policy: Policy | LoraPolicy
    optimiser: optax.OptState


def policy_loss(
    policy: Policy, dynamics: AbstractDynamics[Any], task: AbstractTask, x0: Start, *, delay: int = 0
) -> Float[Array, ""]:
    """Minus the reward, averaged over ticks and over the batch of starts ``x0``. The plain form of the objective."""

    def fly(start: Start) -> Trajectory:
        return rollout(dynamics, task, policy, start, delay=delay)

    flown = jax.vmap(fly)(x0)
    return -jnp.mean(flown.reward)


def policy_gradient(
    policy: Policy, dynamics: AbstractDynamics[Any], task: AbstractTask, x0: Start, *, delay: int = 0
) -> tuple[Float[Array, ""], tuple[eqx.nn.Linear, ...]]:
    """:func:`policy_loss` and its gradient with respect to ``policy.layers``, by taps."""

    def loss(zeros: Taps) -> tuple[Float[Array, ""], Inputs]:
        def fly(start: Start, z: Taps) -> tuple[Trajectory, Inputs]:
            return tapped_rollout(dynamics, task, policy, start, z, delay=delay)

        # Ticks in front, as the scan lays them out: no transposition of what is as large as all activations.
        flown, inputs = jax.vmap(fly, in_axes=(0, 1), out_axes=(0, 1))(x0, zeros)
        return -jnp.mean(flown.reward), inputs

    return taps.value_and_grad(loss, policy, (task.horizon, x0.t.shape[0]))


def bptt(
    state: PolicyState,
    dynamics: AbstractDynamics[Any],
    task: AbstractTask,
    x0: Start,
    *,
    optimiser: optax.GradientTransformation,
    delay: int = 0,
) -> tuple[PolicyState, Float[Array, " epochs"]]:
    """One optimiser step per epoch; ``x0`` holds the starts, epochs x environments. Also returns each epoch's loss.

    Pure and traceable: callers compile it once. A step with a gradient that is not finite is skipped, since one bad
    start must not destroy a policy.
    """

    def epoch(state: PolicyState, starts: Start) -> tuple[PolicyState, Float[Array, ""]]:
        # From what is trained to plain layers and, with the gradient, back; for a plain policy both are the identity.
        layers, pull = jax.vjp(lambda trained: state.policy.retrained(trained).plain().layers, state.policy.trained)
        plain = state.policy.plain().retrained(layers)
        loss, by_layers = policy_gradient(plain, dynamics, task, starts, delay=delay)
        (gradient,) = pull(by_layers)
        update, memory = optimiser.update(gradient, state.optimiser, state.policy.trained)
        trained = optax.apply_updates(state.policy.trained, update)
        fine = jnp.isfinite(optax.tree.norm(gradient))
        trained, memory = jax.tree.map(
            lambda new, old: jnp.where(fine, new, old), (trained, memory), (state.policy.trained, state.optimiser)
        )
        return PolicyState(state.policy.retrained(trained), memory), loss

    return lax.scan(epoch, state, x0)
