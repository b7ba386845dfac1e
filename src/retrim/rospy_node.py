"""rospy, which comes with the system (Debian: ``python3-rospy``), not from a package index: found, and joined.

No other file imports it.
"""

import importlib
import os
import socket
import sys
from pathlib import Path
from types import ModuleType
from typing import Any
from urllib.parse import urlparse

from .errors import ConfigError

SYSTEM = Path("/usr/lib/python3/dist-packages")
"""Where Debian puts packages; a virtual environment does not look there."""


def join(master: str) -> Any:
    """Make this process a node of ROS 1, once, and return rospy.

    Args:
        master: Where the rosmaster is, as ``http://127.0.0.1:11311``.

    Raises:
        ConfigError: rospy is not installed, or there is no master.
    """
    address = urlparse(master)
    try:
        socket.create_connection((address.hostname or "", address.port or 11311), 5.0).close()
    except OSError as error:
        raise ConfigError(f"ROS: no rosmaster at {master!r} ({error})") from error
    os.environ["ROS_MASTER_URI"] = master
    if address.hostname in ("127.0.0.1", "localhost"):  # otherwise its sockets listen everywhere
        os.environ["ROS_IP"] = "127.0.0.1"
    rospy = system_module("rospy")
    rospy.init_node("retrim", anonymous=True, disable_signals=True, disable_rosout=True, disable_rostime=True)
    return rospy


def system_module(name: str) -> ModuleType:
    """Return a module of ROS; the system's packages come after ours.

    Raises:
        ConfigError: It is not installed.
    """
    if str(SYSTEM) not in sys.path and SYSTEM.is_dir():
        sys.path.append(str(SYSTEM))
    try:
        return importlib.import_module(name)
    except ImportError as error:
        package = f"python3-{name.split('.')[0].replace('_', '-')}"
        raise ConfigError(f"ROS 1 needs {name} from the system: apt install {package} ({error})") from error
