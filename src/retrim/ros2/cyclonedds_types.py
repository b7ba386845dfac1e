"""Message types for Cyclone DDS, which carry serialised messages."""

import ctypes
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import version
from typing import Any

from .message_type import MessageType, fields_of

LAYOUT = "11.0."
"""Version of the package whose structure in memory is known."""
TEXT_AT, LENGTH_AT = 0x60, 0x68  # of the description in that structure [bytes]
_TYPES: dict[tuple[str, str, bool], Any] = {}
_BUILDING = threading.Lock()


class _Bytes(bytes):
    """Bytes to which Cyclone DDS can attach the origin of a message."""


def idl_type(kind: MessageType) -> Any:
    """Return the class of Cyclone DDS for a message type; it carries bytes instead of fields."""
    with _BUILDING:
        return _struct(kind.store, kind.name, kind.hash, raw=True)


def _struct(store: Any, name: str, version: str, *, raw: bool) -> Any:
    from cyclonedds.idl import make_idl_struct

    key = (name, version, raw)
    if key not in _TYPES:
        package, middle, short = name.split("/")
        fields = {field: _idl_field(store, each, version) for field, each in fields_of(store, name)}
        result = make_idl_struct(f"{short}_", f"{package}.{middle}.dds_.{short}_", fields)
        if raw:
            result.of_bytes = classmethod(_of_bytes)
            result.serialize = lambda self, *_, **__: self.data_of_message
            result.deserialize = staticmethod(lambda data, *_, **__: _Bytes(data))
        _TYPES[key] = result
    return _TYPES[key]


def _of_bytes(cls: Any, data: bytes) -> Any:
    result = object.__new__(cls)
    result.__dict__["data_of_message"] = data
    return result


def _idl_field(store: Any, field: tuple[Any, Any], version: str) -> Any:
    from cyclonedds.idl import types

    kind, detail = field
    if kind.name == "NAME":
        return _struct(store, detail, version, raw=False)
    if kind.name == "BASE":
        name = {"char": "uint8", "byte": "uint8", "octet": "uint8"}.get(detail[0], detail[0])
        return {"bool": bool, "string": str}.get(name) or getattr(types, name)
    inner, count = _idl_field(store, detail[0], version), detail[1]
    if kind.name == "ARRAY":
        return types.array[inner, count]
    return types.sequence[inner, count] if count else types.sequence[inner]


@contextmanager
def without_description(topic: Any) -> Iterator[None]:
    """Let the readers and writers that are made meanwhile not describe the fields of their type to others.

    Two ends that both describe their types match only if one can resolve the description of the other. Fast DDS 3
    describes arrays with flags that Cyclone DDS refuses, so such ends would never match. Types are compared here by the
    hashes of ROS instead. Where the structure in memory is not the known one, nothing is changed.
    """
    from cyclonedds.internal import load_cyclonedds

    text, structure = topic.data_type.__idl__._xt_bytedata[0], ctypes.c_void_p()
    known = version("cyclonedds").startswith(LAYOUT)
    if not known or load_cyclonedds().dds_get_entity_sertype(ctypes.c_int32(topic._ref), ctypes.byref(structure)) != 0:
        yield
        return
    assert structure.value is not None
    length = ctypes.c_uint32.from_address(structure.value + LENGTH_AT)
    place = ctypes.c_void_p.from_address(structure.value + TEXT_AT).value
    if length.value != len(text) or place is None or ctypes.string_at(place, length.value) != text:
        yield
        return
    length.value = 0
    try:
        yield
    finally:
        length.value = len(text)
