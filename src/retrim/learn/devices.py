"""Divide an axis of environments, flights or vehicles among all JAX devices.

Training with few starts and a small network stays on the CPU: its steps run one after another, and an accelerator
would wait for each program.
"""

from contextlib import AbstractContextManager, nullcontext
from typing import Any, TypeVar

import equinox as eqx
import jax
import numpy as np
from jax import lax
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from ..errors import ConfigError

T = TypeVar("T")

MANY_DEVICES = "many"
"""Name of the divided axis."""


# Product of weights and starts from which an accelerator is faster. On one H200, 300 steps with 16 starts and 20,000
# weights took 5 s (3 s on two CPU cores); 300 steps with 100 starts and 280,000 weights also took 5 s (80 s on the CPU
# cores).
LEAST_WORK = 500_000


def suitable_device(policy: Any, starts: int) -> AbstractContextManager[Any]:
    """Return a context in which training runs on the device that suits its size; small training runs on the CPU.

    Args:
        policy: Policy to train.
        starts: Starts per step.
    """
    weights = sum(leaf.size for leaf in jax.tree.leaves(eqx.filter(policy, eqx.is_array)))
    if jax.default_backend() == "cpu" or jax.device_count() > 1 or weights * starts >= LEAST_WORK:
        return nullcontext()
    on_cpu: AbstractContextManager[Any] = jax.default_device(jax.devices("cpu")[0])
    return on_cpu


def num_shards(n: int, devices: int) -> int:
    """Return the number of devices that share ``n`` equal pieces of work: the largest number that divides ``n``."""
    return max(k for k in range(1, devices + 1) if n % k == 0)


def shard(tree: T, *, axis: int = 0) -> T:
    """Divide the arrays of a tree among the devices, along one common axis; with one device, return the tree unchanged.

    Inside ``jit``, this is a constraint, from which the compiler derives how to divide later computations. Outside, the
    arrays are moved. Values do not change, but sums over the axis are taken in a different order.

    Args:
        tree: Arrays whose axis ``axis`` has the same length; other leaves are unchanged.
        axis: The axis of environments, flights or vehicles.

    Raises:
        ConfigError: There are several hosts, and the length of the axis cannot be divided among their devices.
    """
    leaves = jax.tree.leaves(eqx.filter(tree, eqx.is_array))
    return _lay_out(tree, leaves[0].shape[axis], PartitionSpec(*[None] * axis, MANY_DEVICES)) if leaves else tree


def replicate(tree: T, n: int) -> T:
    """Replicate the arrays of a tree on each device that shares ``n`` pieces of work; see :func:`shard`."""
    return _lay_out(tree, n, PartitionSpec())


def to_default_device(tree: T) -> T:
    """Copy replicated arrays through the host, so that any device may use them; with one device, return them unchanged.

    An array from a program on several devices is bound to these devices; an array from the host is not.
    """
    if jax.device_count() == 1:
        return tree
    here: T = jax.tree.map(lambda leaf: jax.device_put(np.asarray(leaf)) if eqx.is_array(leaf) else leaf, tree)
    return here


def _lay_out(tree: T, n: int, how: PartitionSpec) -> T:
    count = num_shards(n, jax.device_count())
    if jax.process_count() > 1 and count < jax.device_count():
        hosts = jax.process_count()
        raise ConfigError(f"{n} cannot be divided among the {jax.device_count()} devices of {hosts} hosts")
    if count == 1:
        return tree
    arrays, rest = eqx.partition(tree, eqx.is_array)
    mesh = Mesh(np.array(jax.devices()[:count]), (MANY_DEVICES,))
    tree_on_devices: T = eqx.combine(lax.with_sharding_constraint(arrays, NamedSharding(mesh, how)), rest)
    return tree_on_devices
