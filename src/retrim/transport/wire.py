"""Pack pytrees of arrays into messages (:mod:`retrim.transport.message`), and unpack them."""

from collections.abc import Mapping
from typing import Any, TypeVar

import jax

from .message import MAX_BYTES as MAX_BYTES
from .message import describe as describe
from .message import kind_of as kind_of
from .message import pack_arrays, unpack_arrays

T = TypeVar("T")


def names(tree: Any) -> dict[str, Any]:
    """Return the leaves by their dotted paths, for example ``layers.0.weight``."""
    paths = jax.tree_util.tree_leaves_with_path(tree)
    return {jax.tree_util.keystr(path, simple=True, separator="."): leaf for path, leaf in paths}


def pack(tree: Any, *, kind: str, about: Mapping[str, str]) -> bytes:
    """Return the bytes of a message, the inverse of :func:`unpack`.

    Args:
        tree: A pytree of arrays.
        kind: Kind of the content, for example ``policy``.
        about: Header fields; the checksum covers them and the arrays.
    """
    return pack_arrays(names(tree), kind=kind, about=about)


def unpack(data: bytes, like: T, *, kind: str, source: str) -> T:
    """Read a message.

    Args:
        data: Bytes of the message.
        like: A pytree with the expected structure, shapes and types.
        kind: Expected kind of the message.
        source: Origin of the bytes, for error messages.

    Returns:
        The pytree.

    Raises:
        MessageError: The message is truncated, damaged, or of a different kind or shape; or a value is not finite.
    """
    arrays = unpack_arrays(data, names(like), kind=kind, source=source)
    tree: T = jax.tree.unflatten(jax.tree.structure(like), jax.device_put(list(arrays.values())))
    return tree
