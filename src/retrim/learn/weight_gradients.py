"""Compute weight gradients from one product after the scan.

Differentiating a scan that closes over a policy adds to the weight cotangent at every step of the backward pass. This
takes ``horizon`` read-modify-write passes over a 512 x 512 matrix, each for a product with only as many rows as there
are environments. Instead, a zero *perturbation* is added to each pre-activation, and the loss is differentiated with
respect to the perturbations alone. Every weight gradient is formed afterwards, from all rows (environments x ticks) at
once:

    W_l gradient = (pre-activation cotangents of layer l)^T (inputs of layer l).
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..control.policy import Inputs, Layers, Perturbations, Policy

PerturbedLoss = Callable[[Perturbations], tuple[Float[Array, ""], Inputs]]
"""Function from perturbations (per layer: rows... x width) to the loss and each layer's inputs (per layer: rows... x
fan-in)."""


def zero_perturbations(policy: Policy, rows: tuple[int, ...]) -> Perturbations:
    """Return zeros for each layer's output, for each of ``rows``."""
    return tuple(jnp.zeros((*rows, layer.weight.shape[0]), dtype=layer.weight.dtype) for layer in policy.layers)


def value_and_grad(loss: PerturbedLoss, policy: Policy, rows: tuple[int, ...]) -> tuple[Float[Array, ""], Layers]:
    """Return the loss and its gradient with respect to ``policy.layers``, as ``jax.value_and_grad`` does."""
    (value, inputs), cotangents = jax.value_and_grad(loss, has_aux=True)(zero_perturbations(policy, rows))
    gradients = []
    for layer, layer_input, cotangent in zip(policy.layers, inputs, cotangents, strict=True):
        flat = layer_input.reshape(-1, layer_input.shape[-1])
        _, pull = jax.vjp(lambda l, flat=flat: jax.vmap(l)(flat), layer)
        gradients.extend(pull(cotangent.reshape(-1, cotangent.shape[-1])))
    return value, tuple(gradients)
