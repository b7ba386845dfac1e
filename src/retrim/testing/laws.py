"""Assertions of the conformance suites, which report the broken law."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


def shapes(tree: Any) -> Any:
    """Return the structure of a pytree, with the shapes and the types of its leaves."""
    return jax.tree.structure(tree), [(jnp.shape(leaf), jnp.result_type(leaf)) for leaf in jax.tree.leaves(tree)]


def require(holds: bool, law: str) -> None:
    """Raise ``AssertionError`` with the law as its message unless the law holds."""
    if not holds:
        raise AssertionError(f"broken law: {law}")


def close(value: Any, expected: Any, tolerance: float, law: str) -> None:
    """Raise ``AssertionError`` with the law as its message if an error is NaN or larger than the tolerance."""
    away = float(np.max(np.abs(np.asarray(value) - np.asarray(expected))))
    if not away <= tolerance:
        raise AssertionError(f"broken law: {law}; found {np.asarray(value)}, expected {np.asarray(expected)}")
