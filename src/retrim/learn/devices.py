"""Devices that compute: an axis of environments, flights or vehicles is divided among all that JAX has."""

from typing import TypeVar

import equinox as eqx
import jax
import numpy as np
from jax import lax
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from ..errors import ConfigError

T = TypeVar("T")

MANY = "many"
"""Name of the divided axis."""


def shared_by(n: int, devices: int) -> int:
    """Return how many of so many devices share ``n`` equal pieces of work: the largest number that divides it."""
    return max(k for k in range(1, devices + 1) if n % k == 0)


def spread(tree: T, *, axis: int = 0) -> T:
    """Divide the arrays of a tree among the devices, along one axis of them all; with one device, do nothing.

    Inside ``jit`` this is a constraint, from which the compiler divides what is computed of the arrays; outside, the
    arrays are moved. Values do not change, but sums over the axis are taken in another order.

    Args:
        tree: Arrays whose axis ``axis`` has the same length; other leaves stay.
        axis: The axis of environments, flights or vehicles.

    Raises:
        ConfigError: There are several hosts, and their devices do not divide it.
    """
    leaves = jax.tree.leaves(eqx.filter(tree, eqx.is_array))
    return _laid(tree, leaves[0].shape[axis], PartitionSpec(*[None] * axis, MANY)) if leaves else tree


def whole(tree: T, n: int) -> T:
    """Have each device that shares ``n`` pieces of work hold the arrays of a tree whole; see :func:`spread`."""
    return _laid(tree, n, PartitionSpec())


def gathered(tree: T) -> T:
    """Bring arrays that every device has whole to where further work may be done anywhere; with one device, do nothing.

    An array that a program on several devices has made belongs to these; one that comes from the host does not.
    """
    if jax.device_count() == 1:
        return tree
    here: T = jax.tree.map(lambda leaf: jax.device_put(np.asarray(leaf)) if eqx.is_array(leaf) else leaf, tree)
    return here


def _laid(tree: T, n: int, how: PartitionSpec) -> T:
    count = shared_by(n, jax.device_count())
    if jax.process_count() > 1 and count < jax.device_count():
        hosts = jax.process_count()
        raise ConfigError(f"{n} cannot be divided among the {jax.device_count()} devices of {hosts} hosts")
    if count == 1:
        return tree
    arrays, rest = eqx.partition(tree, eqx.is_array)
    mesh = Mesh(np.array(jax.devices()[:count]), (MANY,))
    laid: T = eqx.combine(lax.with_sharding_constraint(arrays, NamedSharding(mesh, how)), rest)
    return laid
