"""Stores networks and training states in a run's folder, to train only once and to resume after an interruption."""

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import random

from ..errors import MessageError
from ..io.files import write_whole
from ..runkit.reporter import Reporter
from ..transport import wire

T = TypeVar("T")
NOTHING: Mapping[str, str] = MappingProxyType({})


def save_tree(path: Path, tree: Any, *, kind: str, about: Mapping[str, str] = NOTHING) -> None:
    """Write a tree's arrays completely or not at all.

    Args:
        path: The file.
        tree: The tree; random keys are written as their key data.
        kind: Kind of content.
        about: Further metadata for readers of the file.
    """
    write_whole(path, wire.pack(_numbers(tree), kind=kind, about=about))


def load_tree(path: Path, like: T, *, kind: str, reporter: Reporter) -> T | None:
    """Return the tree that was written, bit for bit; None if the file is missing or damaged.

    Args:
        path: The file.
        like: A tree with the same structure; it supplies the leaves that are not arrays.
        kind: Expected kind of content.
        reporter: Receives a line if the file is damaged.
    """
    if not path.is_file():
        return None
    try:
        result = wire.unpack(path.read_bytes(), _numbers(like), kind=kind, source=str(path))
    except MessageError as error:
        reporter.say(f"{error}; trained again")
        return None
    arrays, fixed = eqx.partition(like, eqx.is_array)
    whole = jax.tree.map(lambda was, now: random.wrap_key_data(now) if _is_key(was) else now, arrays, result)
    tree: T = eqx.combine(whole, fixed)
    return tree


def _numbers(tree: Any) -> Any:
    """Return a tree's arrays, with random keys as key data."""
    arrays = eqx.filter(tree, eqx.is_array)
    return jax.tree.map(lambda leaf: random.key_data(leaf) if _is_key(leaf) else leaf, arrays)


def _is_key(leaf: Any) -> bool:
    return bool(jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key))
