"""Policy optimisation by back-propagation through time (paper, Sec. III-C, Eq. (2) and (3))."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jax import lax
from jaxtyping import Array, Float

from ..control.lora import LoraPolicy
from ..control.policy import AbstractPolicy, Inputs, Perturbations, Policy
from ..tasks.task import Start
from . import weight_gradients
from .env import Env
from .rollout import Trajectory, rollout, rollout_with_perturbations
from .transposed_layers import with_transposed_copy


class PolicyState(eqx.Module):
    """A policy, plain or low-rank, and the state of its optimiser, which holds moments only for ``policy.params``."""

    policy: AbstractPolicy | LoraPolicy
    optimiser: optax.OptState


def policy_loss(policy: AbstractPolicy, env: Env, x0: Start) -> Float[Array, ""]:
    """Return the negative reward, averaged over ticks and over the batch of starts ``x0`` (leading axis)."""
    flying, copies = with_transposed_copy((policy, env))

    def fly(start: Start) -> Trajectory:
        return rollout(copies, flying, start)

    trajectory = jax.vmap(fly)(x0)
    return -jnp.mean(trajectory.reward)


def policy_gradient(policy: AbstractPolicy, env: Env, x0: Start) -> tuple[Float[Array, ""], Any]:
    """Return :func:`policy_loss` and its gradient with respect to ``policy.params``.

    For a perceptron, the gradient is formed from perturbations of the layers' outputs, which is several times faster;
    see :mod:`retrim.learn.weight_gradients`.
    """
    if isinstance(policy, Policy):
        return _perceptron_gradient(policy, env, x0)
    value: tuple[Float[Array, ""], Any] = jax.value_and_grad(
        lambda params: policy_loss(policy.with_params(params), env, x0)
    )(policy.params)
    return value


def _perceptron_gradient(policy: Policy, env: Env, x0: Start) -> tuple[Float[Array, ""], Any]:
    flying, copies = with_transposed_copy((policy, env))

    def loss(zeros: Perturbations) -> tuple[Float[Array, ""], Inputs]:
        def fly(start: Start, z: Perturbations) -> tuple[Trajectory, Inputs]:
            return rollout_with_perturbations(copies, flying, start, z)

        # Keep time as the leading axis, as the scan lays it out, to avoid transposing activations.
        trajectory, inputs = jax.vmap(fly, in_axes=(0, 1), out_axes=(0, 1))(x0, zeros)
        return -jnp.mean(trajectory.reward), inputs

    return weight_gradients.value_and_grad(loss, policy, (env.task.horizon, x0.t.shape[0]))


def bptt(
    state: PolicyState, env: Env, x0: Start, *, optimiser: optax.GradientTransformation
) -> tuple[PolicyState, Float[Array, " updates"]]:
    """Optimise a policy with one optimiser step per row of starts.

    The function is pure and traceable, so callers compile it once. A step whose gradient is not finite is skipped,
    since one bad start must not destroy a policy.

    Args:
        state: Policy and optimiser state to start from.
        env: Model, task and delay.
        x0: Starts with two leading axes, updates x environments.
        optimiser: The optimiser that created ``state.optimiser``.

    Returns:
        The new state, and the loss before each step.
    """

    def update(state: PolicyState, starts: Start) -> tuple[PolicyState, Float[Array, ""]]:
        # Map params to those of the merged policy, and pull the gradient back; without a delta both are the identity.
        policy, pull = jax.vjp(lambda params: state.policy.with_params(params).merged().params, state.policy.params)
        plain = state.policy.merged().with_params(policy)
        loss, by_params = policy_gradient(plain, env, starts)
        (gradient,) = pull(by_params)
        change, memory = optimiser.update(gradient, state.optimiser, state.policy.params)
        params = optax.apply_updates(state.policy.params, change)
        fine = jnp.isfinite(optax.tree.norm(gradient))
        params, memory = jax.tree.map(
            lambda new, old: jnp.where(fine, new, old), (params, memory), (state.policy.params, state.optimiser)
        )
        return PolicyState(state.policy.with_params(params), memory), loss

    return lax.scan(update, state, x0)
