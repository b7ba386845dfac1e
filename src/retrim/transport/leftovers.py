"""Buses in shared memory that nobody uses any more, since all who did were killed.

Each process that has joined a bus holds a lock on a file beside the topics, which the operating system releases when
the process ends, in whichever way. A bus whose lock nobody holds is left over.
"""

import contextlib
import fcntl
import os
import shutil
from pathlib import Path

LOCK = "lock"


def begin(folder: Path) -> int:
    """Make the lock of a new bus and hold it; return its descriptor. It appears when it is held, never before."""
    made = folder / f"{LOCK}.new"
    descriptor = os.open(made, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o600)
    fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    made.rename(folder / LOCK)
    return descriptor


def hold(folder: Path) -> int:
    """Hold the lock of a bus until the descriptor is closed.

    Raises:
        OSError: There is no such bus, or it is being taken away.
    """
    descriptor = os.open(folder / LOCK, os.O_RDWR)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError:
        os.close(descriptor)
        raise
    return descriptor


def clear(base: Path, prefix: str) -> list[Path]:
    """Remove the buses of this user that are left over; return their folders.

    Args:
        base: Where the folders of buses are.
        prefix: How their names begin. A folder without a lock is somebody else's, or is just being made.
    """
    cleared = []
    for folder in base.glob(f"{prefix}*"):
        with contextlib.suppress(OSError):
            if folder.is_symlink() or folder.stat().st_uid != os.getuid():
                continue
            descriptor = os.open(folder / LOCK, os.O_RDWR | os.O_NOFOLLOW)
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)  # somebody who holds it lives
                shutil.rmtree(folder, ignore_errors=True)
                cleared.append(folder)
            finally:
                os.close(descriptor)
    return cleared
