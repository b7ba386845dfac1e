"""Choose the back end of a ROS 2 node."""

from collections.abc import Callable, Iterable, Mapping
from importlib.util import find_spec

from ..errors import ConfigError
from .message_type import message_type
from .node import Ros2Node, domain_id
from .zenoh_node import ROUTER

BACKENDS = ("rclpy", "cyclonedds", "zenoh")
"""Back ends, in the order in which they are tried."""
MODULES = {"rclpy": "rclpy", "cyclonedds": "cyclonedds", "zenoh": "zenoh"}


def choose_backend(packages: Iterable[str]) -> str:
    """Return the first back end that is installed with the message types of some packages.

    Args:
        packages: Packages of message types; only rclpy needs them to be installed.

    Raises:
        ConfigError: No back end is installed.
    """
    for name in BACKENDS:
        if is_installed(MODULES[name]) and (name != "rclpy" or all(is_installed(each) for each in packages)):
            return name
    raise ConfigError(
        "ROS 2 needs rclpy (source the setup file of ROS 2), or cyclonedds, or zenoh; in a checkout: "
        "`uv pip install -e '.[ros2]'`; elsewhere: `pip install cyclonedds rosbags`"
    )


def open_node(backend: str, packages: Iterable[str], router: str = "", domain: int | None = None) -> Ros2Node:
    """Return a node.

    Args:
        backend: Name of the back end; empty to choose the first that is installed.
        packages: Packages of the message types that will be exchanged.
        router: ``HOST:PORT`` of the router of rmw_zenoh; empty for the one on this machine.
        domain: Domain of ROS; None for the one of ``ROS_DOMAIN_ID``.

    Raises:
        ConfigError: There is no such back end, it is not installed, or it cannot join the network.
    """
    if backend and backend not in BACKENDS:
        raise ConfigError(f"no back end {backend!r} of ROS 2; there are {', '.join(BACKENDS)}")
    message_type("std_msgs/msg/Header")  # an error if rosbags is missing
    return _opening(router, domain_id() if domain is None else domain)[backend or choose_backend(packages)]()


def is_installed(module: str) -> bool:
    """Return whether a module can be imported, without importing it."""
    try:
        return find_spec(module) is not None
    except (ImportError, ValueError):  # a module that was replaced by None
        return False


def _opening(router: str, domain: int) -> Mapping[str, Callable[[], Ros2Node]]:
    def cyclone() -> Ros2Node:
        from .cyclonedds_node import CycloneNode

        return CycloneNode(domain)

    def rclpy() -> Ros2Node:
        from .rclpy_node import RclpyNode

        return RclpyNode(domain)

    def zenoh() -> Ros2Node:
        from .zenoh_node import ZenohNode

        return ZenohNode(router or ROUTER, domain=domain)

    return {"rclpy": rclpy, "cyclonedds": cyclone, "zenoh": zenoh}
