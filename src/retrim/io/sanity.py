"""Checks whether a policy can be flown. A checksum proves that a file is intact, but its numbers may be unusable."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..control.policy import AbstractPolicy
from ..errors import CheckpointError, excerpt

LARGEST = 1e5
"""Largest weight. Trained weights are below 100; larger ones overflow within a few layers in single precision."""
THRUST, RATES = 1000.0, 1000.0
"""Largest command limits: [m/s^2], [rad/s]; those of a racing quadrotor are 150 and 40."""
TRIALS = 8


def check_policy(policy: AbstractPolicy, *, source: str, observation: np.ndarray | None = None) -> None:
    """Check the weights, the limits, and the commands at and near hover.

    Args:
        policy: Policy to check; a low-rank policy must be merged.
        source: Origin of the policy; error messages begin with it.
        observation: Observation at hover; zeros by default.

    Raises:
        CheckpointError: A weight or limit is not finite or is too large, the limits do not enclose hover, or a command
            is not finite.
    """
    low, hover, high = (_double(u.vector()) for u in (policy.u_min, policy.u_hover, policy.u_max))
    most = np.array([THRUST, RATES, RATES, RATES])
    if not all(np.all(np.abs(u) <= most) for u in (low, hover, high)):
        raise CheckpointError(
            f"{source}: command limits {_format(low)} to {_format(high)} must be within +-{THRUST:g} m/s^2 and "
            f"+-{RATES:g} rad/s"
        )
    if not (np.all(low < hover) and np.all(hover < high)):
        raise CheckpointError(
            f"{source}: command limits {_format(low)} to {_format(high)} do not enclose hover, {_format(hover)}"
        )
    check_size(policy.params, source=source)
    layers = policy.linear_layers()
    if not layers and observation is None:
        return
    size = layers[0].weight.shape[1] if observation is None else len(observation)
    rows = np.random.default_rng(0).normal(size=(TRIALS, size))
    rows[0] = 0.0 if observation is None else observation
    with np.errstate(all="ignore"):
        h = _outputs(policy, rows.astype(np.float32))
        y0 = np.log((hover - low) / (high - hover))
        commands = low + (high - low) / (1.0 + np.exp(-(h + y0)))
    if not (np.isfinite(h).all() and np.isfinite(commands).all()):
        raise CheckpointError(f"{source}: its command at hover is not finite; the weights cannot be flown")


def _outputs(policy: AbstractPolicy, rows: np.ndarray) -> np.ndarray:
    """Return the network's outputs for rows of observations; for a perceptron, NumPy is used to avoid compilation."""
    layers, h = policy.linear_layers(), rows
    if not layers:
        return np.stack([np.asarray(eqx.filter_jit(policy.output)(jnp.asarray(row))) for row in rows])
    for i, layer in enumerate(layers):
        h = h @ np.asarray(layer.weight, np.float32).T + np.asarray(layer.bias, np.float32)
        h = h if i == len(layers) - 1 else np.maximum(h, 0.0)
    return h


def check_size(tree: Any, *, source: str, largest: float = LARGEST) -> None:
    """Check that all floating-point numbers in a tree are finite and not too large for weights.

    Args:
        tree: A pytree of arrays.
        source: Origin of the tree; error messages begin with it.
        largest: Largest absolute value.

    Raises:
        CheckpointError: A number is not finite or is too large.
    """
    for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
        if np.asarray(leaf).dtype.kind != "f" or not np.size(leaf):
            continue
        result = float(np.max(np.abs(np.asarray(leaf))))
        if not result <= largest:
            name = jax.tree_util.keystr(path, simple=True, separator=".")
            raise CheckpointError(
                f"{source}: {excerpt(name, quotes=False)} holds {result:.3g}; at most {largest:g} can be flown"
            )


def _double(vector: Any) -> np.ndarray:
    return np.asarray(vector, dtype=float)


def _format(vector: np.ndarray) -> str:
    return "[" + ", ".join(f"{x:.4g}" for x in vector) + "]"
