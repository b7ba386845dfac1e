"""Networks, and states of learning, in the folder of a run: what takes long to train is trained once, and goes on."""

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
from ..transport import wire
from .reporter import Reporter

T = TypeVar("T")
NOTHING: Mapping[str, str] = MappingProxyType({})


def keep_tree(path: Path, tree: Any, *, kind: str, about: Mapping[str, str] = NOTHING) -> None:
    """Write the arrays of a tree, whole or not at all.

    Args:
        path: The file.
        tree: Its random keys are written as the numbers that they are made of.
        kind: What it is.
        about: What else is told of it, for who opens the file.
    """
    write_whole(path, wire.pack(_numbers(tree), kind=kind, about=about))


def kept_tree(path: Path, like: T, *, kind: str, reporter: Reporter) -> T | None:
    """Return what was written, the same to the bit; None if there is nothing, or nothing whole, which is said.

    Args:
        path: The file.
        like: A tree of the same structure, with what is no array.
        kind: What it should be.
        reporter: Hears of a file that is damaged.
    """
    if not path.is_file():
        return None
    try:
        found = wire.unpack(path.read_bytes(), _numbers(like), kind=kind, source=str(path))
    except MessageError as error:
        reporter.say(f"{error}; trained again")
        return None
    arrays, fixed = eqx.partition(like, eqx.is_array)
    whole = jax.tree.map(lambda was, now: random.wrap_key_data(now) if _is_key(was) else now, arrays, found)
    tree: T = eqx.combine(whole, fixed)
    return tree


def _numbers(tree: Any) -> Any:
    """The arrays of a tree."""
    arrays = eqx.filter(tree, eqx.is_array)
    return jax.tree.map(lambda leaf: random.key_data(leaf) if _is_key(leaf) else leaf, arrays)


def _is_key(leaf: Any) -> bool:
    return bool(jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key))
