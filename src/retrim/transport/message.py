"""Encode named arrays as bytes, in one format for files and messages.

The content of a message is never executed. A message is a safetensors file. Its header holds the format, the kind, and
a checksum of the tensors. Reading validates names, shapes, types and finiteness against the expected arrays before any
object is built.
"""

import hashlib
import json
from collections.abc import Mapping
from typing import Any, Protocol, runtime_checkable

import numpy as np
from safetensors import SafetensorError, deserialize
from safetensors.numpy import load, save

from ..errors import MessageError

FORMAT = "retrim/1"
MAX_BYTES = 256 * 2**20
MAX_HEADER = 4 * 2**20
UNNAMED = "nothing"


@runtime_checkable
class ArrayLike(Protocol):
    """Expected shape and type of an array: any array of that shape and type is accepted."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the array."""
        ...

    @property
    def dtype(self) -> Any:
        """Type of the elements."""
        ...


def pack_arrays(arrays: Mapping[str, Any], *, kind: str, about: Mapping[str, str]) -> bytes:
    """Return the bytes of a message, the inverse of :func:`unpack_arrays`; equal content gives equal bytes.

    Args:
        arrays: Arrays by name.
        kind: Kind of the content, for example ``policy``.
        about: Header fields; the checksum covers them and the arrays.
    """
    tensors = {name: np.array(array, order="C") for name, array in arrays.items()}
    header = {**about, "format": FORMAT, "kind": kind}
    return _in_order(save(tensors, metadata=header | {"checksum": _checksum(tensors, header)}))


def describe(data: bytes, *, kind: str, source: str) -> dict[str, str]:
    """Return the header of a message.

    Raises:
        MessageError: The data is not a complete message of this format and ``kind``.
    """
    header = _header(data, source)
    if (result := header.get("kind", UNNAMED)) != kind:
        raise MessageError(f"{source}: holds a {result!r}, expected a {kind!r}")
    return header


def kind_of(data: bytes, *, source: str) -> str:
    """Return the kind of a message.

    Raises:
        MessageError: The data is not a complete message of this format.
    """
    return _header(data, source).get("kind", UNNAMED)


def unpack_arrays(data: bytes, expected: Mapping[str, ArrayLike], *, kind: str, source: str) -> dict[str, np.ndarray]:
    """Read a message.

    Args:
        data: Bytes of the message.
        expected: Shape and type of each array, by name.
        kind: Expected kind of the message.
        source: Origin of the bytes, for error messages.

    Returns:
        The arrays, in the order of ``expected``.

    Raises:
        MessageError: The message is truncated, damaged, or of a different kind or shape; or a value is not finite.
    """
    header = describe(data, kind=kind, source=source)
    try:
        tensors = load(data)
    except (SafetensorError, KeyError, ValueError) as error:
        raise MessageError(f"{source}: a tensor of an unsupported type ({error})") from error
    result: dict[str, np.ndarray] = {}
    for name in sorted(expected.keys() | tensors.keys()):
        if name not in tensors:
            raise MessageError(f"{source}: tensor {name!r} is missing")
        if name not in expected:
            raise MessageError(f"{source}: unexpected tensor {name!r}; expected {', '.join(sorted(expected))}")
        there, expectation = tensors[name], expected[name]
        if there.shape != expectation.shape:
            raise MessageError(
                f"{source}: tensor {name!r} has shape {there.shape}, expected {tuple(expectation.shape)}"
            )
        real = np.dtype(expectation.dtype).kind == "f"
        if there.dtype.kind not in ("f" if real else "iu"):
            expects = "floating point" if real else "integers"
            raise MessageError(f"{source}: tensor {name!r} has type {there.dtype}, expected {expects}")
        with np.errstate(over="ignore"):
            result[name] = there.astype(expectation.dtype)
        if not (finite := np.isfinite(result[name])).all():
            wrong = finite.size - np.count_nonzero(finite)
            raise MessageError(f"{source}: tensor {name!r} has {wrong} weights that are not finite")
    if header.pop("checksum", None) != _checksum(tensors, header):
        raise MessageError(f"{source}: the checksum does not match; the file was damaged or edited")
    return {name: result[name] for name in expected}


def _in_order(data: bytes) -> bytes:
    """Return a safetensors file with a sorted header, because the library's own order changes from call to call."""
    end = 8 + int.from_bytes(data[:8], "little")
    text = json.dumps(json.loads(data[8:end]), sort_keys=True, separators=(",", ":"), ensure_ascii=False).encode()
    text += b" " * (-len(text) % 8)
    return len(text).to_bytes(8, "little") + text + data[end:]


def _header(data: bytes, source: str) -> dict[str, str]:
    """Return the header of a complete message."""
    if len(data) > MAX_BYTES:
        raise MessageError(f"{source}: {len(data)} bytes, more than the {MAX_BYTES} that are accepted")
    if MAX_HEADER < (size := int.from_bytes(data[:8], "little")) <= len(data):
        raise MessageError(f"{source}: a header of {size} bytes, more than the {MAX_HEADER} that are accepted")
    try:
        deserialize(data)
    except SafetensorError as error:
        raise MessageError(f"{source}: not a whole safetensors file; truncated or of another kind ({error})") from error
    header = dict(json.loads(data[8 : 8 + size]).get("__metadata__") or {})
    if header.get("format") != FORMAT:
        raise MessageError(f"{source}: format {header.get('format', 'none')!r}, expected {FORMAT!r}")
    return header


def _checksum(tensors: Mapping[str, np.ndarray], header: Mapping[str, str]) -> str:
    digest = hashlib.sha256(json.dumps(dict(header), sort_keys=True).encode())
    for name in sorted(tensors):
        digest.update(name.encode())
        digest.update(tensors[name].tobytes())
    return digest.hexdigest()
