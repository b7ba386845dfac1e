"""Parameters as bytes: one format for files and, later, for the bus. Nothing in it is ever executed.

A message is a safetensors file whose header says what it is: format, kind, and a checksum of the tensors. Reading
validates names, shapes, types and finiteness against what is expected before anything is built.
"""

import hashlib
import json
from collections.abc import Mapping
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from safetensors import SafetensorError, deserialize
from safetensors.numpy import load, save

T = TypeVar("T")

FORMAT = "retrim/1"
MAX_BYTES = 256 * 2**20


class WireError(ValueError):
    """A message that must not be used. The text names the message, what is wrong, and what was expected."""


def names(tree: Any) -> dict[str, Any]:
    """Leaves by their dotted path, as in ``layers.0.weight``."""
    paths = jax.tree_util.tree_leaves_with_path(tree)
    return {jax.tree_util.keystr(path, simple=True, separator="."): leaf for path, leaf in paths}


def pack(tree: Any, *, kind: str, about: Mapping[str, str]) -> bytes:
    """The arrays of ``tree`` and what ``about`` says of them; the checksum covers both."""
    tensors = {name: np.array(leaf, order="C") for name, leaf in names(tree).items()}
    header = {**about, "format": FORMAT, "kind": kind}
    return save(tensors, metadata=header | {"checksum": _checksum(tensors, header)})


def describe(data: bytes, *, kind: str, source: str) -> dict[str, str]:
    """The header of a message; raises :class:`WireError` unless it is a whole message of this ``kind``."""
    if len(data) > MAX_BYTES:
        raise WireError(f"{source}: {len(data)} bytes, more than the {MAX_BYTES} that are accepted")
    try:
        deserialize(data)
    except SafetensorError as error:
        raise WireError(f"{source}: not a whole safetensors file; truncated or of another kind ({error})") from error
    header = _metadata(data)
    if header.get("format") != FORMAT:
        raise WireError(f"{source}: format {header.get('format', 'none')!r}, expected {FORMAT!r}")
    if header.get("kind") != kind:
        raise WireError(f"{source}: holds a {header.get('kind', 'nothing')!r}, expected a {kind!r}")
    return header


def unpack(data: bytes, like: T, *, kind: str, source: str) -> T:
    """The tree in ``data``, of the structure, shapes and types of ``like``; raises :class:`WireError` otherwise."""
    header = describe(data, kind=kind, source=source)
    try:
        tensors = load(data)
    except (SafetensorError, KeyError, ValueError) as error:
        raise WireError(f"{source}: a tensor of a type that is not used here ({error})") from error
    expected = names(like)
    for name in sorted(expected.keys() | tensors.keys()):
        if name not in tensors:
            raise WireError(f"{source}: tensor {name!r} is missing")
        if name not in expected:
            raise WireError(f"{source}: unexpected tensor {name!r}; expected {', '.join(sorted(expected))}")
        there, wanted = tensors[name], expected[name]
        if there.shape != wanted.shape:
            raise WireError(f"{source}: tensor {name!r} has shape {there.shape}, expected {tuple(wanted.shape)}")
        if not np.issubdtype(there.dtype, np.floating):
            raise WireError(f"{source}: tensor {name!r} has type {there.dtype}, expected floating point")
        if not np.isfinite(there).all():
            raise WireError(f"{source}: tensor {name!r} has {np.sum(~np.isfinite(there))} weights that are not finite")
    if header.pop("checksum", None) != _checksum(tensors, header):
        raise WireError(f"{source}: the checksum does not match; the file was damaged or edited")
    leaves = [jnp.asarray(tensors[name], dtype=wanted.dtype) for name, wanted in expected.items()]
    tree: T = jax.tree.unflatten(jax.tree.structure(like), leaves)
    return tree


def _metadata(data: bytes) -> dict[str, str]:
    size = int.from_bytes(data[:8], "little")
    return dict(json.loads(data[8 : 8 + size]).get("__metadata__", {}))


def _checksum(tensors: Mapping[str, np.ndarray], header: Mapping[str, str]) -> str:
    digest = hashlib.sha256(json.dumps(dict(header), sort_keys=True).encode())
    for name in sorted(tensors):
        digest.update(name.encode())
        digest.update(tensors[name].tobytes())
    return digest.hexdigest()
