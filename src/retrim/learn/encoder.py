"""Pretrain a vision policy's hidden layers to predict the state from images.

The paper (Sec. IV-A.2, after Heeg et al.) trains these layers on flights of a random policy. Here, the histories are
synthetic: random motions with constant velocity and body rates, redrawn at each step, without roll-outs.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jax import lax, random
from jaxtyping import Array, Float, Key

from ..control.policy import Policy
from ..tasks.motions import NEAR, Motions
from ..tasks.observation import AbstractObservation


@eqx.filter_jit
def pretrain_encoder(
    policy: Policy,
    observation: AbstractObservation[Any],
    key: Key[Array, ""],
    *,
    motions: Motions = NEAR,
    steps: int = 3000,
    batch: int = 512,
) -> tuple[Policy, Float[Array, " steps"]]:
    """Train the hidden layers of ``policy`` to predict [p, R, v]; the output layer is unchanged.

    The optimiser is Adam with a cosine schedule from 1e-3. The layers are first reinitialised with Glorot scaling,
    since the weights of a fresh policy are small.

    Args:
        policy: A policy with at least one hidden layer.
        observation: The observation of the policy, which provides examples of states.
        key: Random key, consumed.
        motions: Distribution of the motions for training; the encoder does not generalise far beyond it.
        steps: Optimiser steps.
        batch: Random motions per step.

    Returns:
        The policy, and the mean absolute error of the scaled state before each step.
    """
    k_layers, k_out, k_train = random.split(key, 3)
    hidden = policy.layers[:-1]
    fresh = [_glorot(layer, k) for layer, k in zip(hidden, random.split(k_layers, len(hidden)), strict=True)]
    head = _glorot(eqx.nn.Linear(policy.layers[-1].weight.shape[1], 15, key=k_out), k_out)
    optimiser = optax.adam(optax.cosine_decay_schedule(1e-3, steps))

    sample = observation.state_examples(motions)
    assert sample is not None, f"{type(observation).__name__} provides no examples of states"

    def loss(layers: list[eqx.nn.Linear], key: Key[Array, ""]) -> Float[Array, ""]:
        h, state = jax.vmap(sample)(random.split(key, batch))
        for layer in layers[:-1]:
            h = jax.nn.relu(jax.vmap(layer)(h))
        return jnp.mean(jnp.abs(jax.vmap(layers[-1])(h) - state))

    def step(
        carry: tuple[list[eqx.nn.Linear], optax.OptState], key: Key[Array, ""]
    ) -> tuple[tuple[list[eqx.nn.Linear], optax.OptState], Float[Array, ""]]:
        layers, memory = carry
        error, gradient = jax.value_and_grad(loss)(layers, key)
        update, memory = optimiser.update(gradient, memory, layers)
        return (optax.apply_updates(layers, update), memory), error

    start = [*fresh, head]
    (layers, _), errors = lax.scan(step, (start, optimiser.init(start)), random.split(k_train, steps))
    return policy.with_params((*layers[:-1], policy.layers[-1])), errors


def _glorot(layer: eqx.nn.Linear, key: Key[Array, ""]) -> eqx.nn.Linear:
    fan_out, fan_in = layer.weight.shape
    weight = (2.0 / (fan_in + fan_out)) ** 0.5 * random.normal(key, (fan_out, fan_in), layer.weight.dtype)
    fresh: eqx.nn.Linear = eqx.tree_at(lambda l: (l.weight, l.bias), layer, (weight, jnp.zeros(fan_out, weight.dtype)))
    return fresh
