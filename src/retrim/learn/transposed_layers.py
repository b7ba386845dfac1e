"""Weights in both layouts, so that each product in a roll-out's scan reads its matrix along the rows.

In the forward pass, a layer multiplies a few rows by a fan-in x fan-out matrix; in the backward pass, by a fan-out x
fan-in matrix. A CPU multiplies ten rows by the transpose of a stored matrix at a third to half of the rate for the
matrix itself. A scan would do this at every tick, so both layouts are computed once, before the scan.
"""

from typing import TypeGuard, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

Tree = TypeVar("Tree")


class TransposedLinear(eqx.nn.Linear):
    """A linear layer that also holds its transposed weight; its gradients are those of the plain layer."""

    transposed: Float[Array, "*members fan_in fan_out"]

    def __init__(self, layer: eqx.nn.Linear) -> None:
        """Store both layouts of a layer, or of several layers that ``jax.vmap`` has stacked."""
        self.weight, self.bias, self.use_bias = layer.weight, layer.bias, layer.use_bias
        self.in_features, self.out_features = layer.in_features, layer.out_features
        self.transposed = layer.weight.mT

    def __call__(self, x: Float[Array, " fan_in"], *, key: Key[Array, ""] | None = None) -> Float[Array, " fan_out"]:
        """Return the layer's output for one input; the key is ignored, as in the plain layer."""
        y = _product(self.weight, self.transposed, x)
        return y if self.bias is None else y + self.bias


def with_transposed_copy(tree: Tree) -> Tree:
    """Return the same tree (policy, model or environment) with every linear layer in both layouts.

    A subclass of a linear layer may compute something different, so it stays unchanged.
    """

    def is_layer(leaf: object) -> TypeGuard[eqx.nn.Linear]:
        return type(leaf) is eqx.nn.Linear and "scalar" not in (leaf.in_features, leaf.out_features)

    copies: Tree = jax.tree.map(lambda leaf: TransposedLinear(leaf) if is_layer(leaf) else leaf, tree, is_leaf=is_layer)
    return copies


@jax.custom_vjp
def _product(
    weight: Float[Array, "fan_out fan_in"], transposed: Float[Array, "fan_in fan_out"], x: Float[Array, " fan_in"]
) -> Float[Array, " fan_out"]:
    return x @ transposed


def _forward(weight: Array, transposed: Array, x: Array) -> tuple[Array, tuple[Array, Array]]:
    return x @ transposed, (weight, x)


def _backward(inputs: tuple[Array, Array], y: Array) -> tuple[Array, Array, Array]:
    weight, x = inputs
    return jnp.outer(y, x), jnp.zeros_like(weight.T), y @ weight


_product.defvjp(_forward, _backward)
