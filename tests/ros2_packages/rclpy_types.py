"""Type supports for rclpy that are made from definitions, without a compiler.

rclpy from the package index has neither px4_msgs nor mavros_msgs. The classes here give rcl and Fast DDS the name, the
hash and the size of such a type, so a genuine node can publish and receive its messages in serialised form. Messages
cannot be converted to objects.
"""

import ctypes

from std_msgs.msg import Header

from retrim.ros2.message_type import MessageType

IDENTIFIER = b"rosidl_typesupport_fastrtps_c"
LARGEST = 4096  # [bytes], of a message of variable length


class TypeHash(ctypes.Structure):
    """rosidl_type_hash_t."""

    _fields_ = (("version", ctypes.c_uint8), ("value", ctypes.c_uint8 * 32))


GET = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p)
GET_HANDLE = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p, ctypes.c_char_p)
CONVERT = ctypes.CFUNCTYPE(ctypes.c_bool, ctypes.c_void_p, ctypes.c_void_p)
SIZE = ctypes.CFUNCTYPE(ctypes.c_uint32, ctypes.c_void_p)
LARGEST_SIZE = ctypes.CFUNCTYPE(ctypes.c_size_t, ctypes.POINTER(ctypes.c_char))


class Callbacks(ctypes.Structure):
    """message_type_support_callbacks_t."""

    _fields_ = (
        ("namespace", ctypes.c_char_p), ("name", ctypes.c_char_p), ("serialize", CONVERT), ("deserialize", CONVERT),
        ("size", SIZE), ("largest", LARGEST_SIZE), ("key", ctypes.c_void_p),
    )  # fmt: skip


class TypeSupport(ctypes.Structure):
    """rosidl_message_type_support_t."""

    _fields_ = (
        ("identifier", ctypes.c_char_p), ("data", ctypes.c_void_p), ("handle", GET_HANDLE), ("hash", GET),
        ("description", GET), ("sources", GET),
    )  # fmt: skip


new_capsule = ctypes.pythonapi.PyCapsule_New
new_capsule.restype, new_capsule.argtypes = ctypes.py_object, (ctypes.c_void_p, ctypes.c_char_p, ctypes.c_void_p)
pointer_of = ctypes.pythonapi.PyCapsule_GetPointer
pointer_of.restype, pointer_of.argtypes = ctypes.c_void_p, (ctypes.py_object, ctypes.c_char_p)
name_of = ctypes.pythonapi.PyCapsule_GetName
name_of.restype, name_of.argtypes = ctypes.c_char_p, (ctypes.py_object,)
_ALIVE = []  # objects to which the C libraries refer


def class_for(kind: MessageType, type_hash: str = "") -> type:
    """Return a class that rclpy accepts as a message type.

    Args:
        kind: The message type.
        type_hash: Hash that the class claims; empty for the hash of the type.
    """
    package, middle, short = kind.name.split("/")
    size = kind.size or LARGEST
    digits = (type_hash or kind.hash).removeprefix("RIHS01_")
    hash_value = TypeHash(1, (ctypes.c_uint8 * 32)(*bytes.fromhex(digits)))

    def largest(bounds: ctypes.POINTER(ctypes.c_char)) -> int:
        bounds[0] = b"\0"  # neither bounded nor plain: the length of each message is relevant
        return size

    callbacks = Callbacks(
        f"{package}::{middle}".encode(), short.encode(), CONVERT(lambda *_: False), CONVERT(lambda *_: False),
        SIZE(lambda _: size), LARGEST_SIZE(largest), None,
    )  # fmt: skip
    lent = _of_header()  # rcl stores a description with each type, but compares hashes only
    support = TypeSupport(
        IDENTIFIER, ctypes.addressof(callbacks),
        GET_HANDLE(lambda _, name: ctypes.addressof(support) if name == IDENTIFIER else None),
        GET(lambda _: ctypes.addressof(hash_value)), GET(lambda _: lent.description(None)),
        GET(lambda _: lent.sources(None)),
    )  # fmt: skip
    capsule = new_capsule(ctypes.addressof(support), None, None)
    _ALIVE.append((hash_value, callbacks, lent, support, capsule))

    class Meta(type):
        _CREATE_ROS_MESSAGE = _CONVERT_FROM_PY = _CONVERT_TO_PY = _DESTROY_ROS_MESSAGE = _TYPE_SUPPORT = capsule

        @classmethod
        def __import_type_support__(cls) -> None:
            """Do nothing: the type support exists."""

    return Meta(short, (), {"__slots__": ()})


def _of_header() -> TypeSupport:
    """Return the type support of a genuine message."""
    meta = type(Header)
    meta.__import_type_support__()
    capsule = meta._TYPE_SUPPORT
    return TypeSupport.from_address(pointer_of(capsule, name_of(capsule)))
