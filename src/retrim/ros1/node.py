"""Find rospy and start its node. rospy is a system package (Debian: ``python3-rospy``); it is not on package indexes.

No other file imports rospy.
"""

import importlib
import os
import socket
import sys
from pathlib import Path
from types import ModuleType
from typing import Any
from urllib.parse import urlparse

from ..errors import ConfigError

SYSTEM = Path("/usr/lib/python3/dist-packages")
"""Debian's package folder, which virtual environments do not search."""


def join(master: str) -> Any:
    """Make this process a ROS 1 node, unless it is one already, and return rospy.

    Args:
        master: Address of the rosmaster, such as ``http://127.0.0.1:11311``.

    Raises:
        ConfigError: rospy is not installed, or the rosmaster cannot be reached.
    """
    address = urlparse(master)
    try:
        socket.create_connection((address.hostname or "", address.port or 11311), 5.0).close()
    except (OSError, UnicodeError) as error:  # UnicodeError: an impossible name
        raise ConfigError(f"ROS: no rosmaster at {master!r} ({error})") from error
    os.environ["ROS_MASTER_URI"] = master
    if address.hostname in ("127.0.0.1", "localhost"):  # otherwise its sockets listen on all interfaces
        os.environ["ROS_IP"] = "127.0.0.1"
    rospy = system_module("rospy")
    rospy.init_node("retrim", anonymous=True, disable_signals=True, disable_rosout=True, disable_rostime=True)
    return rospy


def system_module(name: str) -> ModuleType:
    """Return a ROS module, searching system packages after those of the environment.

    Raises:
        ConfigError: The module is not installed.
    """
    if str(SYSTEM) not in sys.path and SYSTEM.is_dir():
        sys.path.append(str(SYSTEM))
    try:
        return importlib.import_module(name)
    except ImportError as error:
        package = f"python3-{name.split('.')[0].replace('_', '-')}"
        raise ConfigError(f"ROS 1 needs {name} from the system: apt install {package} ({error})") from error
