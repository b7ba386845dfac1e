"""Stack trees of one structure into one tree with a leading axis, and take them apart again."""

from collections.abc import Sequence
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import random
from jaxtyping import Array

from .devices import shard

T = TypeVar("T")


def stack(trees: Sequence[T]) -> T:
    """Return trees of one structure as one tree, with a leading axis that is divided among the devices."""
    arrays = [eqx.filter(tree, eqx.is_array) for tree in trees]
    together = jax.tree.map(lambda *leaves: _stack(leaves), *arrays)
    whole: T = shard(eqx.combine(together, eqx.filter(trees[0], eqx.is_array, inverse=True)))
    return whole


def unstack(tree: T, i: int) -> T:
    """Return one of the trees that :func:`stack` has stacked."""
    result: T = jax.tree.map(lambda leaf: _take(leaf, i), tree)
    return result


def _stack(leaves: Sequence[Any]) -> Array:
    """Stack arrays in NumPy, to avoid compiling a program for every shape."""
    if _is_key(leaves[0]):
        return jnp.stack(leaves)
    whole: Array = jax.device_put(np.stack([np.asarray(leaf) for leaf in leaves]))
    return whole


def _take(leaf: Any, i: int) -> Array:
    if _is_key(leaf):
        key: Array = random.wrap_key_data(_take(random.key_data(leaf), i), impl=random.key_impl(leaf))
        return key
    part: Array = jax.device_put(np.asarray(leaf)[i])
    return part


def _is_key(leaf: Any) -> bool:
    return bool(jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key))
