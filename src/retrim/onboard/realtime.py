"""Operating-system settings for a process with deadlines, and waits on the monotonic clock."""

import contextlib
import ctypes
import gc
import os
import select
import time

LOCK_NOW_AND_LATER = 3  # MCL_CURRENT | MCL_FUTURE
TIMER_SLACK = 2e-5  # [s]


def be_punctual(priority: int, cores: set[int]) -> list[str]:
    """Request real-time scheduling, locked memory and specific cores, and disable garbage collection.

    Args:
        priority: Priority under SCHED_FIFO, 1 to 99.
        cores: Cores that the process may use.

    Returns:
        Descriptions of the refused requests; empty if all were granted.
    """
    refusals = []
    gc.collect()
    gc.freeze()
    gc.disable()
    # Locking touches all the memory and takes a while, so lock before raising the priority.
    try:
        if ctypes.CDLL(None, use_errno=True).mlockall(LOCK_NOW_AND_LATER) != 0:
            refusals.append(f"locked memory: {os.strerror(ctypes.get_errno())}")
    except (OSError, AttributeError) as error:
        refusals.append(f"locked memory: {error}")
    try:
        for thread in _threads():
            os.sched_setaffinity(thread, cores)
    except (OSError, AttributeError) as error:
        refusals.append(f"cores {sorted(cores)}: {error}")
    try:
        for thread in _threads():  # a thread pool that computes for this process is as urgent as the process
            os.sched_setscheduler(thread, os.SCHED_FIFO, os.sched_param(priority))
    except (OSError, AttributeError) as error:
        refusals.append(f"SCHED_FIFO: {error}")
    return refusals


def _threads() -> list[int]:
    """Return the threads of this process, with the calling one last."""
    with contextlib.suppress(OSError):
        return [int(name) for name in os.listdir("/proc/self/task") if int(name) != os.getpid()] + [0]
    return [0]


def cores_of(role: str, available: set[int] | None = None) -> set[int]:
    """Return the cores of a role: the first core to fly, the other cores to learn; both roles share a single core.

    Args:
        role: ``fly`` or ``learn``.
        available: Cores to distribute; by default those of this process.
    """
    mine = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else {0}
    cores = sorted(available or mine)
    return {cores[0]} if role == "fly" or len(cores) == 1 else set(cores[1:])


def sleep_until(instant: float) -> None:
    """Sleep until ``instant`` on the monotonic clock [s]; return immediately if the instant has passed."""
    while (left := instant - time.monotonic()) > TIMER_SLACK:
        time.sleep(left)


def wait_until(instant: float) -> float:
    """Wait until ``instant`` on the monotonic clock [s] without sleeping, which avoids wake-up delays.

    Returns:
        The current time [s], which may be later than ``instant``.
    """
    while (now := time.monotonic()) < instant:
        pass
    return now


class ParentWatch:
    """Detects immediately when another process ends, without the cooperation of that process."""

    def __init__(self, pid: int) -> None:
        """Watch a process on this machine."""
        self.pid, self._poll = pid, select.poll()
        self._descriptor: int | None = None
        with contextlib.suppress(OSError, AttributeError):
            self._descriptor = os.pidfd_open(pid)
            self._poll.register(self._descriptor, select.POLLIN)

    def has_ended(self, wait: float = 0.0) -> bool:
        """Wait at most ``wait`` [s] for the end of the process, and return whether it has ended."""
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
