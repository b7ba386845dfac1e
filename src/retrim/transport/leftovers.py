"""Remove buses in shared memory that are left over because all of their processes were killed.

Each process that has joined a bus holds a lock on a file in the folder of the topics. The operating system releases the
lock when the process ends for any reason. If no process holds the lock of a bus, the bus is left over.
"""

import contextlib
import fcntl
import os
import shutil
from pathlib import Path

LOCK = "lock"


def begin(folder: Path) -> int:
    """Create and hold the lock of a new bus, and return its descriptor.

    The lock file appears only once the lock is held.
    """
    new_path = folder / f"{LOCK}.new"
    descriptor = os.open(new_path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o600)
    fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    new_path.rename(folder / LOCK)
    return descriptor


def hold(folder: Path) -> int:
    """Hold the lock of a bus until the descriptor is closed.

    Raises:
        OSError: There is no such bus, or it is being removed.
    """
    descriptor = os.open(folder / LOCK, os.O_RDWR)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError:
        os.close(descriptor)
        raise
    return descriptor


def clear(base: Path, prefix: str) -> list[Path]:
    """Remove this user's leftover buses, and return their folders.

    Args:
        base: Parent folder of the buses.
        prefix: Prefix of the folder names. A folder without a lock is not removed: it has a different owner, or is just
            being created.
    """
    clear_paths = []
    for folder in base.glob(f"{prefix}*"):
        with contextlib.suppress(OSError):
            if folder.is_symlink() or folder.stat().st_uid != os.getuid():
                continue
            descriptor = os.open(folder / LOCK, os.O_RDWR | os.O_NOFOLLOW)
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)  # fails while a live process holds the lock
                shutil.rmtree(folder, ignore_errors=True)
                clear_paths.append(folder)
            finally:
                os.close(descriptor)
    return clear_paths
