"""Assertions of the conformance suites, which report the broken law."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


def shapes(tree: Any) -> Any:
    """Return the structure, the shapes and the types of a pytree."""
    return jax.tree.structure(tree), [(jnp.shape(leaf), jnp.result_type(leaf)) for leaf in jax.tree.leaves(tree)]


def require(holds: bool, law: str) -> None:
    """Raise ``AssertionError`` with the law unless it holds."""
    if not holds:
        raise AssertionError(f"broken law: {law}")


def close(found: Any, expected: Any, tolerance: float, law: str) -> None:
    """Raise ``AssertionError`` with the law if an error is NaN or larger than the tolerance."""
    away = float(np.max(np.abs(np.asarray(found) - np.asarray(expected))))
    if not away <= tolerance:
        raise AssertionError(f"broken law: {law}; found {np.asarray(found)}, expected {np.asarray(expected)}")
