"""What the operating system can do for a process that must be on time; each step is tried, and said where it fails."""

import contextlib
import ctypes
import gc
import os
import select
import time

LOCK_NOW_AND_LATER = 3  # MCL_CURRENT | MCL_FUTURE
LATER = 2e-5  # [s]


def be_punctual(priority: int, cores: set[int]) -> list[str]:
    """Ask for real-time scheduling, locked memory and cores of one's own, and stop collecting garbage.

    Args:
        priority: Of SCHED_FIFO, 1 to 99.
        cores: Where the process may run.

    Returns:
        What was refused, in words; empty if nothing was.
    """
    refused = []
    gc.collect()
    gc.freeze()
    gc.disable()
    # Touching all its memory takes a while: before the process is more important than others.
    try:
        if ctypes.CDLL(None, use_errno=True).mlockall(LOCK_NOW_AND_LATER) != 0:
            refused.append(f"locked memory: {os.strerror(ctypes.get_errno())}")
    except (OSError, AttributeError) as error:
        refused.append(f"locked memory: {error}")
    try:
        for thread in _threads():
            os.sched_setaffinity(thread, cores)
    except (OSError, AttributeError) as error:
        refused.append(f"cores {sorted(cores)}: {error}")
    try:
        for thread in _threads():  # a pool that computes for this process is as urgent as it
            os.sched_setscheduler(thread, os.SCHED_FIFO, os.sched_param(priority))
    except (OSError, AttributeError) as error:
        refused.append(f"SCHED_FIFO: {error}")
    return refused


def _threads() -> list[int]:
    """Threads of this process; the calling one last."""
    with contextlib.suppress(OSError):
        return [int(name) for name in os.listdir("/proc/self/task") if int(name) != os.getpid()] + [0]
    return [0]


def cores_of(role: str, allowed: set[int] | None = None) -> set[int]:
    """Return the cores of a role: the first one flies, the others learn; with a single core all share it.

    Args:
        role: ``fly`` or ``learn``.
        allowed: Cores to share out; by default those of this process.
    """
    mine = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else {0}
    cores = sorted(allowed or mine)
    return {cores[0]} if role == "fly" or len(cores) == 1 else set(cores[1:])


def sleep_until(instant: float) -> None:
    """Return at ``instant`` of the monotonic clock [s], or at once if it has passed."""
    while (left := instant - time.monotonic()) > LATER:
        time.sleep(left)


def wait_until(instant: float) -> float:
    """Return at ``instant`` of the monotonic clock [s] without sleeping, so that nobody has to wake the process.

    Returns:
        When it is, which is later if the instant has passed [s].
    """
    while (now := time.monotonic()) < instant:
        pass
    return now


class Lifeline:
    """Tells whether another process lives, at once and without asking it."""

    def __init__(self, pid: int) -> None:
        """Watch a process of this machine."""
        self.pid, self._poll = pid, select.poll()
        self._descriptor: int | None = None
        with contextlib.suppress(OSError, AttributeError):
            self._descriptor = os.pidfd_open(pid)
            self._poll.register(self._descriptor, select.POLLIN)

    def gone(self, wait: float = 0.0) -> bool:
        """Return whether the process has ended, after waiting for that at most ``wait`` [s]."""
        if self._descriptor is not None:
            return bool(self._poll.poll(max(0.0, 1e3 * wait)))
        time.sleep(max(0.0, wait))
        try:
            os.kill(self.pid, 0)
        except ProcessLookupError:
            return True
        except PermissionError:
            return False
        return False
