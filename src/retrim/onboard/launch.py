"""Start the processes of a live flight. Each process receives a plan; Ctrl-C reaches only the supervisor."""

import contextlib
import importlib
import os
import pickle
import subprocess
import sys
from pathlib import Path
from typing import Any, BinaryIO

PYTHON = (sys.executable, "-P", "-m")
"""Command that runs a module of this package; files in the current folder cannot shadow its modules."""


def module_path() -> str:
    """Return the module path of a child process: the path of this process, with the current folder moved to the end.

    The current folder may contain a user's module, but a ``numpy.py`` in the same folder does not replace NumPy.
    """
    here, places = os.path.realpath(os.curdir), [place for place in sys.path if place]
    last = [place for place in places if os.path.realpath(place) == here]
    return os.pathsep.join([*(place for place in places if place not in last), *last[:1]])


def launch(main: str, plan: Any, complaints: Path, cores: set[int] | None = None) -> "subprocess.Popen[bytes]":
    """Start a process on this machine.

    Args:
        main: Name of a function that takes the plan, as ``module:function``.
        plan: Argument of the function; this process sends it only to its own child.
        complaints: File for the standard output and standard error of the process.
        cores: Cores that the process may use, even during its imports; None for all cores.

    Returns:
        The process.
    """
    # One thread: the arrays are small, and a thread pool would add delays.
    quiet = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
    with _open_log(complaints) as file:
        process = subprocess.Popen(
            [*PYTHON, "retrim.onboard.launch", main],
            stdin=subprocess.PIPE,
            stdout=file,
            stderr=file,
            start_new_session=True,
            env=os.environ | quiet | {"PYTHONPATH": module_path()},
        )
    if cores is not None and hasattr(os, "sched_setaffinity"):
        with contextlib.suppress(OSError):
            os.sched_setaffinity(process.pid, cores)
    assert process.stdin is not None
    with contextlib.suppress(BrokenPipeError), process.stdin as pipe:  # whoever waits for a dead process notices
        pickle.dump(plan, pipe)
    return process


def _open_log(complaints: Path) -> BinaryIO:
    """Open a file to append to it; if its folder is not writable, open the null device instead."""
    try:
        complaints.parent.mkdir(parents=True, exist_ok=True)
        return complaints.open("ab")
    except OSError:
        return Path(os.devnull).open("ab")


def last_words(complaints: Path) -> str:
    """Return the last line that a process wrote to its standard output or error."""
    try:
        lines = complaints.read_text(errors="replace").strip().splitlines()
    except OSError:
        return "it left no word"
    return lines[-1] if lines else "without a word"


def main() -> None:
    """Read the plan and run the named function."""
    module, _, name = sys.argv[1].partition(":")
    function = getattr(importlib.import_module(module), name)
    function(pickle.load(sys.stdin.buffer))  # the parent wrote this pickle


if __name__ == "__main__":
    main()
