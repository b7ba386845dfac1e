"""Digests that identify files and the arrays of pytrees."""

import hashlib
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np

DIGITS = 16


def file_digest(path: Path) -> str:
    """Return a digest of a file's bytes."""
    return hashlib.sha256(path.read_bytes()).hexdigest()[:DIGITS]


def tree_digest(tree: Any) -> str:
    """Return a digest of the arrays in a pytree."""
    digest = hashlib.sha256()
    for leaf in jax.tree.leaves(eqx.filter(tree, eqx.is_array)):
        digest.update(np.ascontiguousarray(leaf).tobytes())
    return digest.hexdigest()[:DIGITS]


def text_digest(text: str) -> str:
    """Return a digest of a text."""
    return hashlib.sha256(text.encode()).hexdigest()[:DIGITS]
