"""Message types: their hashes, and their serialisation as CDR by rosbags."""

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..errors import ConfigError, MessageError
from .definitions import DEFINITIONS, NEWEST, release_of, title_of

NO_HASH = "TypeHashNotSupported"
"""Hash of a type in the keys of releases before Iron, which have no hashes."""
WORD = 4
"""DDS transmits whole words, so a message may be up to three bytes longer than its content."""
FNV_BASIS, FNV_PRIME = 0x811C9DC5, 0x01000193


@dataclass(frozen=True)
class MessageType:
    """A message type in the form of one release."""

    name: str
    """Name, such as ``px4_msgs/msg/VehicleCommand``."""
    release: str
    """First release that has this form; empty for the types of ROS itself."""
    store: Any
    """Type store of rosbags that contains the type."""
    hash: str
    """Hash of the fields, ``RIHS01_`` and 64 digits."""

    @property
    def title(self) -> str:
        """Package and releases that have this form, for messages."""
        return title_of(self.name, self.release)

    @property
    def dds_name(self) -> str:
        """Name of the type in DDS."""
        package, kind, short = self.name.split("/")
        return f"{package}::{kind}::dds_::{short}_"

    @functools.cached_property
    def size(self) -> int | None:
        """Number of bytes of every message, including the header of four; None if the length varies."""
        return len(self.encode(self.new())) if _is_fixed(self.store, self.name) else None

    def new(self) -> Any:
        """Return a message whose numbers are zero and whose texts are empty."""
        return _zero(self.store, self.name)

    def encode(self, message: Any) -> bytes:
        """Return a message as CDR, with the header that states the byte order."""
        return bytes(self.store.serialize_cdr(message, self.name))

    def decode(self, data: bytes) -> Any:
        """Return the message in CDR bytes.

        Raises:
            MessageError: The bytes are not a message of this type; the error names the release that has this length.
        """
        if self.size is not None and not 0 <= len(data) - self.size < WORD:
            raise MessageError(
                f"{self.name} of {len(data)} bytes, which is the length in {_title_by_size(self.name, len(data))}; "
                f"this end has {self.title}, {self.size} bytes"
            )
        fault: Exception | None = None
        for padding in range(WORD) if self.size is None else [len(data) - self.size]:
            try:
                return self.store.deserialize_cdr(data[: len(data) - padding], self.name)
            except Exception as error:  # rosbags raises various errors for bytes from strangers
                fault = fault or error
        raise MessageError(f"{self.name}: {len(data)} bytes that cannot be read ({fault})") from fault


@functools.cache
def message_type(name: str, release: str = NEWEST) -> MessageType:
    """Return a message type.

    Args:
        name: Name, such as ``nav_msgs/msg/Odometry``.
        release: Release of PX4 whose form the type has; the types of ROS itself have one form.

    Raises:
        ConfigError: rosbags is not installed.
    """
    base = _ros_types()
    if name not in DEFINITIONS:
        return MessageType(name, "", base, base.hash_rihs01(name))
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    form = release_of(name, release)
    store = get_typestore(Stores.EMPTY)
    store.register({**base.fielddefs, **get_types_from_msg(DEFINITIONS[name][form], name)})
    return MessageType(name, form, store, store.hash_rihs01(name))


def title_by_hash(name: str, type_hash: str) -> str:
    """Return the description of the release whose type has a hash, or state that it is unknown."""
    for form in DEFINITIONS.get(name, {}):
        if message_type(name, form).hash == type_hash:
            return title_of(name, form)
    return f"an unknown version ({type_hash[:15]}...)"


def px4_hash(name: str, release: str = NEWEST) -> int:
    """Return the hash by which PX4 recognises a message: FNV-1a of the lines ``type name`` of its fields."""
    result = FNV_BASIS
    for byte in DEFINITIONS[name][release_of(name, release)].encode():
        result = (result ^ byte) * FNV_PRIME & 0xFFFFFFFF
    return result


def title_by_px4_hash(name: str, value: int) -> str:
    """Return the description of the release whose message has a hash of PX4, or state that it is unknown."""
    for form in DEFINITIONS[name]:
        if px4_hash(name, form) == value:
            return title_of(name, form)
    return f"an unknown version (hash {value:#010x})"


def _title_by_size(name: str, size: int) -> str:
    for form in DEFINITIONS.get(name, {}):
        if (expected := message_type(name, form).size) is not None and 0 <= size - expected < WORD:
            return title_of(name, form)
    return "an unknown version"


@functools.cache
def _ros_types() -> Any:
    try:
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise ConfigError("ROS 2 needs rosbags for its message types: pip install rosbags") from error
    return get_typestore(Stores.ROS2_JAZZY)


def fields_of(store: Any, name: str) -> Sequence[tuple[str, tuple[Any, Any]]]:
    """Return the fields of a message type in a type store of rosbags: names, and kinds with details."""
    result: Sequence[tuple[str, tuple[Any, Any]]] = store.fielddefs[name][1]
    return result


def _zero(store: Any, name: str) -> Any:
    return store.types[name](*(_zero_field(store, kind) for _, kind in fields_of(store, name)))


def _zero_field(store: Any, field: tuple[Any, Any]) -> Any:
    kind, detail = field
    if kind.name == "NAME":
        return _zero(store, detail)
    if kind.name == "BASE":
        return {"string": "", "bool": False, "float32": 0.0, "float64": 0.0}.get(detail[0], 0)
    (inner_kind, inner), count = detail
    count = count if kind.name == "ARRAY" else 0
    if inner_kind.name == "BASE" and inner[0] != "string":
        dtype = {"char": "uint8", "byte": "uint8", "octet": "uint8"}.get(inner[0], inner[0])
        return np.zeros(count, dtype)
    return [_zero_field(store, (inner_kind, inner)) for _ in range(count)]


def _is_fixed(store: Any, name: str) -> bool:
    return all(_is_fixed_field(store, kind) for _, kind in fields_of(store, name))


def _is_fixed_field(store: Any, field: tuple[Any, Any]) -> bool:
    kind, detail = field
    if kind.name == "NAME":
        return _is_fixed(store, detail)
    if kind.name == "BASE":
        return bool(detail[0] not in ("string", "wstring"))
    return bool(kind.name == "ARRAY") and _is_fixed_field(store, detail[0])
